"""Table 3: PSNR of left-out points. ``python -m eval.table3``; see ``eval.tables``."""

import sys

from eval.tables import main

if __name__ == "__main__":
    sys.exit(main(3))
