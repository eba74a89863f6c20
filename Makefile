# Two commands do everything: `make render` and `make test`; `make docs` builds the site. PYTHON names the interpreter that makes .venv.
PYTHON ?= python3
VENV := .venv
STAMPS := .make
PIP_INSTALL := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
INPUTS := pyproject.toml constraints.txt
SPHINX := --builder html --fresh-env --fail-on-warning --keep-going --nitpicky --quiet

.PHONY: render test test-extended test-gpu lint browser docs clean

render: $(STAMPS)/package
	$(VENV)/bin/mitsplat render scenes/workcell.yaml -o out/workcell --resume

# In the order of the files: left to itself, the plugin ends with those of few tests, of which some take minutes.
TWO_PROCESSES := --numprocesses 2 --dist loadfile --no-loadscope-reorder
test: $(STAMPS)/tools
	$(VENV)/bin/python -m pytest $(TWO_PROCESSES)

# The tests marked `extended`, which pytest leaves out otherwise.
test-extended: $(STAMPS)/tools
	$(VENV)/bin/python -m pytest $(TWO_PROCESSES) -m extended

# What renders, on the GPU; tests/gpu also compares it with the CPU. The tests share the GPU.
GPU_TESTS := tests/gpu tests/renderer tests/frames tests/fit tests/bake
test-gpu: $(STAMPS)/tools
	$(VENV)/bin/python -m pytest -m '' --device cuda --numprocesses 6 --dist loadfile $(GPU_TESTS)

lint: $(STAMPS)/tools
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/mypy
	$(VENV)/bin/python -m pytest -q tests/test_package_structure.py

# What the tests of the live view look at it with; they are skipped where it is missing. On Debian, as root.
browser:
	@command -v chromedriver > /dev/null || { apt-get update --quiet && apt-get install --yes --quiet chromium chromium-driver; }

# docs/_build/html/index.html; NOTEBOOKS=1 also runs the notebooks, so that the pages show what they print.
docs: $(STAMPS)/docs
	$(VENV)/bin/python -m sphinx $(SPHINX) docs docs/_build/html
	$(VENV)/bin/python docs/links.py docs/_build/html

clean:
	rm -rf $(VENV) $(STAMPS) docs/_build build mitsplat.egg-info

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

$(STAMPS)/docs: $(STAMPS)/package
	$(PIP_INSTALL) --editable '.[docs]'
	@touch $@
