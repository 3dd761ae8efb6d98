"""The paper's figures: ``python -m eval.figures --figure 8 9``."""
