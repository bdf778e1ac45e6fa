# The two commands of the README. Each installs what it needs into .venv first; nothing else
# on the machine is touched.
PYTHON ?= python3
PY := .venv/bin/python

.PHONY: demo test lint clean

demo: .venv/installed
	$(PY) -m svu_mi demo -o out/demo

test: .venv/installed-test lint
	$(PY) -m pytest

lint: .venv/installed-test
	$(PY) -m ruff check .
	$(PY) -m mypy

# A virtual environment whose interpreter no longer runs is made again.
.venv/usable: FORCE
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "svu_mi needs Python 3.11 or later; try: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 2; }
	@$(PY) -m pip --version >/dev/null 2>&1 || { rm -rf .venv && $(PYTHON) -m venv .venv || \
	  { echo "No virtual environment could be made; on Debian: apt install python3-venv" >&2; exit 2; }; }
	@test -f $@ || touch $@

.venv/installed: pyproject.toml | .venv/usable
	$(PY) -m pip install --quiet --disable-pip-version-check -e .
	@touch $@

.venv/installed-test: pyproject.toml | .venv/usable
	$(PY) -m pip install --quiet --disable-pip-version-check -e '.[test]'
	@touch $@ .venv/installed

clean:
	rm -rf .venv build out *.egg-info .mypy_cache .pytest_cache .ruff_cache

FORCE:
