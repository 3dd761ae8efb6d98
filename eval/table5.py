"""Table 5: MSE of left-out points. ``python -m eval.table5``; see ``eval.tables``."""

import sys

from eval.tables import main

if __name__ == "__main__":
    sys.exit(main(5))
