# make setup   everything into .venv/        make fly    watch three drones explore
# make test    the tests                     make lint   style, types and import floors
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt
FLY ?= --level 4 --drones 3

.PHONY: setup fly test lint format clean

setup: $(VENV)/.developer

fly: $(VENV)/.pilot
	$(BIN)/imagine fly --sim $(FLY)

test: $(VENV)/.developer
	$(BIN)/python -m pytest $(TESTS)

lint: $(VENV)/.developer
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q --no-header --durations=0 tests/command/test_floors.py

format: $(VENV)/.developer
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info

# What flying needs is small; training and tests bring torch and more.
$(VENV)/.pilot: pyproject.toml constraints.txt | $(VENV)/.made
	$(PIP) --editable '.[gcs]'
	@touch $@

$(VENV)/.developer: pyproject.toml constraints.txt | $(VENV)/.made
	$(PIP) --editable '.[gcs,train,study,dev]'
	@touch $@ $(VENV)/.pilot

$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "IMAGINE needs Python 3.11 or newer; give one with: make PYTHON=python3.12 setup" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	@touch $@
