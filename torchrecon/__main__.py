"""``python -m torchrecon`` is the command line."""

import sys

from torchrecon.cli import main

sys.exit(main())
