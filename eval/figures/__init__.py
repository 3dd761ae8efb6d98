"""The paper's figures, one command: ``python -m eval.figures --figure 1 2 ...``."""
