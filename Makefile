# `make train` and `make test` set up .venv when they must; everything else builds on them.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
export GOMP_SPINCOUNT ?= 3000

.PHONY: train test test-slow check format clean

train: $(VENV)/.installed  ## train Gradient-Guided TD3: about a minute on two cores
	$(RUN)/python recipes/td3_gradient_guided.py $(ARGS)

test: $(VENV)/.installed-dev  ## the fast tests
	$(RUN)/python -m pytest $(ARGS)

test-slow: $(VENV)/.installed-dev  ## the tests that train, minutes long
	$(RUN)/python -m pytest -m slow $(ARGS)

check: $(VENV)/.installed-dev  ## lint, format and types
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/mypy

format: $(VENV)/.installed-dev
	$(RUN)/ruff format .
	$(RUN)/ruff check --fix .

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .mypy_cache

# torch comes first and alone: with it in place, nothing else pulls another build of it.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN)/pip install --quiet --disable-pip-version-check $$(grep '^torch==' constraints.txt)
	$(RUN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(RUN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@
