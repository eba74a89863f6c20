# Two commands do everything: `make render` and `make test`. PYTHON names the interpreter that makes .venv.
PYTHON ?= python3
VENV := .venv
STAMPS := .make
PIP_INSTALL := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
INPUTS := pyproject.toml constraints.txt

.PHONY: render test lint clean

render: $(STAMPS)/package
	$(VENV)/bin/mitsplat render scenes/workcell.yaml -o out/workcell --resume

test: $(STAMPS)/tools
	$(VENV)/bin/python -m pytest

lint: $(STAMPS)/tools
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/mypy

clean:
	rm -rf $(VENV) $(STAMPS) build mitsplat.egg-info

$(STAMPS)/venv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "mitsplat needs Python 3.11 or newer; name one: make PYTHON=python3.12 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@mkdir -p $(STAMPS) && touch $@

$(STAMPS)/package: $(STAMPS)/venv $(INPUTS)
	$(PIP_INSTALL) --editable .
	@touch $@

$(STAMPS)/tools: $(STAMPS)/package
	$(PIP_INSTALL) --editable '.[test,dev]'
	@touch $@
