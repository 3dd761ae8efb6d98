"""How far the estimates can be relied on, by rates and coverage: ``python -m eval.reliability``."""
