# The commands of the README: demo, test, test-all and docs. Each first installs what it needs into .venv,
# once per change of pyproject.toml; nothing else on the machine is touched.

PYTHON ?= python3
PY := .venv/bin/python
PIP := $(PY) -m pip --disable-pip-version-check
# As pip does to what it copies; where PYTHONDONTWRITEBYTECODE is set, it would be done by every process.
COMPILE := $(PY) -m compileall -q svu_mi plugins
TOO_OLD := svu_mi needs Python 3.11 or newer; try: make PYTHON=python3.12
NO_VENV := Python cannot make a virtual environment here; on Debian and Ubuntu: apt install python3-venv
# Debian without python3-venv lacks only ensurepip; the system's pip, if any, can fill in.
VENV_WITHOUT_ENSUREPIP = $(PYTHON) -m venv --clear --without-pip .venv && \
  $(PYTHON) -m pip --python $(PY) install --quiet pip

.PHONY: demo test test-all lint docs clean

demo: .venv/installed
	.venv/bin/svu demo -o out/demo

test: lint
	$(PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m 'not slow'

test-all: lint
	$(PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder

lint: .venv/installed-test
	$(PY) -m ruff check .
	$(PY) -m mypy --num-workers 2
	@$(PY) tests/support/prose.py

docs: .venv/installed-docs
	$(PY) -m sphinx --quiet --fail-on-warning --keep-going --conf-dir notebooks . out/docs
	$(PY) -m sphinx --quiet --builder doctest --doctree-dir out/docs/.doctrees --conf-dir notebooks . out/examples
	@echo "Wrote out/docs/README.html"

.venv/installed: pyproject.toml .venv/here
	@echo "Installing svu_mi and what it needs into .venv"
	$(PIP) install --quiet -e .
	@$(COMPILE)
	@touch $@

.venv/installed-test: pyproject.toml .venv/here
	@echo "Installing svu_mi, what it needs, and its test tools into .venv"
	$(PIP) install --quiet -e '.[test,docs]'
	@$(COMPILE)
	@touch .venv/installed .venv/installed-docs $@

.venv/installed-docs: pyproject.toml .venv/here
	@echo "Installing svu_mi, what it needs, and Sphinx into .venv"
	$(PIP) install --quiet -e '.[docs]'
	@$(COMPILE)
	@touch .venv/installed $@

# Checked every time, touched only when something changed: an environment whose interpreter or
# pip no longer runs is made again; one that came from another folder is installed into again,
# because its scripts and its editable install name that folder.
.venv/here: FORCE
	@if ! $(PY) -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
	  $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "$(TOO_OLD)" >&2; exit 2; }; \
	  echo "Making a virtual environment in .venv"; \
	  rm -rf .venv; \
	  $(PYTHON) -m venv .venv >/dev/null || { $(VENV_WITHOUT_ENSUREPIP); } || \
	    { rm -rf .venv; echo "$(NO_VENV)" >&2; exit 2; }; \
	fi
	@echo '$(CURDIR)' | cmp -s - $@ || echo '$(CURDIR)' > $@

clean:
	rm -rf .venv build dist out *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache

FORCE:
