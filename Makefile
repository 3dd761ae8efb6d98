# Two commands do everything on a fresh clone with Python 3.11+ and make: `make table1` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2

.PHONY: setup table1 test fuzz lint kill page docs clean

setup: $(VENV)/.stamp

$(VENV)/.stamp: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "torchrecon needs Python 3.11 or newer; set PYTHON=/path/to/python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

table1: setup
	$(BIN)/python -m eval.table1

test: setup lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --durations=20 -q

fuzz: setup
	$(BIN)/python -m tests.fuzz --count 2000

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	PYTHONPATH=. $(BIN)/lint-imports

kill: setup
	$(BIN)/python -m tests.kill

# The report page in a headless Chromium (Debian: chromium chromium-driver): size, time to load, frame rate, pictures.
page: setup
	$(BIN)/python -m eval.page

# The documentation site in docs/_build/html; warnings are errors, nothing is fetched once its packages are there.
docs: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html

clean:
	rm -rf $(VENV) docs/_build docs/pictures docs/reference .mypy_cache .ruff_cache .pytest_cache .import_linter_cache build *.egg-info
