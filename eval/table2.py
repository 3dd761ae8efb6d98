"""Table 2: matching degree and reconstruction accuracy. ``python -m eval.table2``; see ``eval.tables``."""

import sys

from eval.tables import main

if __name__ == "__main__":
    sys.exit(main(2))
