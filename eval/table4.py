"""Table 4: SSIM of left-out points. ``python -m eval.table4``; see ``eval.tables``."""

import sys

from eval.tables import main

if __name__ == "__main__":
    sys.exit(main(4))
