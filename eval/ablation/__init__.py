"""What the paper's stages and its number of bases are worth, one command: ``python -m eval.ablation``."""
