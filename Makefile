# `make train` and `make test` create .venv if necessary. `make help` lists the targets.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
RECIPE := $(RUN)/python recipes

.PHONY: train fly anywhere test coverage test-slow test-newest matrix check format lock docs docs-slow notebook bench mutate tables figures pictures help clean

train: $(VENV)/.installed  ## train Gradient-Guided TD3; about a minute on two cores
	$(RECIPE)/td3_gradient_guided.py $(ARGS)

fly: $(VENV)/.installed  ## fly the pretrained agent from Bergen to Reykjavik; seconds
	$(RECIPE)/fly.py "60.4N 5.3E" "64.1N 21.9W" $(ARGS)

anywhere: $(VENV)/.installed  ## train the agent without a map for all distances; three quarters of an hour on one core
	OMP_NUM_THREADS=1 $(RECIPE)/ppo_anywhere.py $(ARGS)

# Processes share the modules that pytest compiles, also where the environment asks Python to keep none.
test: $(VENV)/.installed-dev  ## run the fast tests, one process per core with one thread each
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(RUN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal $(ARGS)

coverage:  ## run the fast tests with coverage, half as long again; below 97 % of lines and branches it fails
	$(MAKE) test ARGS=--cov

test-slow: $(VENV)/.installed-dev  ## run the slow tests (trainings); several minutes
	$(RUN)/python -m pytest -m slow $(ARGS)

test-newest:  ## run the fast tests with the newest release of TorchRL, in build/newest; they may fail
	$(MAKE) VENV=build/newest build/newest/.installed-dev
	build/newest/bin/pip install --quiet --disable-pip-version-check --upgrade torchrl tensordict
	-$(MAKE) VENV=build/newest test

matrix:  ## run the fast tests with each of Python 3.11 to 3.13 that is installed, in build/python3.X
	for name in python3.11 python3.12 python3.13; do \
	  ! $$name --version || $(MAKE) PYTHON=$$name VENV=build/$$name test || exit 1; \
	done

check: $(VENV)/.installed-dev  ## check lint, format and types
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/mypy

format: $(VENV)/.installed-dev  ## format the code
	$(RUN)/ruff format .
	$(RUN)/ruff check --fix .

lock:  ## write constraints.txt with the newest versions of all but torch, from an environment in build/lock
	rm -rf build/lock
	$(MAKE) VENV=build/lock CONSTRAINTS=/dev/null build/lock/.installed-dev build/lock/.installed-docs
	build/lock/bin/pip freeze --all --exclude pip --exclude magrl > build/lock/versions
	head -n 1 constraints.txt > build/lock/constraints.txt
	sed 's/+.*//; /^\(cuda\|nvidia\|triton\)/d' build/lock/versions >> build/lock/constraints.txt
	mv build/lock/constraints.txt constraints.txt

SPHINX := $(RUN)/python -m sphinx -b html -d build/doctrees -W --keep-going --quiet

docs: $(VENV)/.installed-docs  ## build the documentation in build/docs, with the outputs that the tutorial keeps
	$(SPHINX) -D nb_execution_mode=off docs build/docs
	@echo "Open build/docs/index.html"

docs-slow: $(VENV)/.installed-docs  ## build it and run the tutorial; two minutes
	$(SPHINX) docs build/docs
	@echo "Open build/docs/index.html"

notebook: $(VENV)/.installed-docs  ## run the tutorial and keep its outputs in docs/tutorial.ipynb; two minutes
	OMP_NUM_THREADS=1 $(RUN)/python docs/tables/notebook.py

bench: $(VENV)/.installed-dev  ## run the benchmarks; about four minutes on two cores
	$(RUN)/python -m benchmarks $(ARGS)

mutate: $(VENV)/.installed-dev  ## try random mutants of the code, 40 or ARGS="--count 100 --seed 1"; half an hour on one core
	$(RUN)/python -m benchmarks.mutants $(ARGS)

# Tables and figures. Runs that exist are used again; `make -j2` trains and makes two at a time, with one thread each.
ONE := OMP_NUM_THREADS=1 $(RUN)/python
FIVE := 0 1 2 3 4
AGENTS := $(foreach run,td3_gradient_guided-fast td3_gradient_guided-fast-no-cost td3-fast td3-fast-cost,$(FIVE:%=$(run)-seed%))
RUNS_table-comparison := $(AGENTS)
RUNS_table-noise := $(foreach run,td3_gradient_guided-fast td3_gradient_guided-fast-noise,$(FIVE:%=$(run)-seed%))
RUNS_table-paper-run := td3_gradient_guided-paper-seed0 td3-paper-seed0
RUNS_figure-learning := $(RUNS_table-paper-run)
TABLES ?= $(shell sed -n 's/^\[\([a-z0-9_-]*\)\]$$/\1/p' docs/tables/tables.toml)
FIGURES ?= place-error section-4 learning conditions two-elements reliability

tables: $(TABLES:%=table-%)  ## make the tables of the documentation, all or TABLES="earth noise"; hours with all trainings
	$(RUN)/python docs/tables/publish.py README.md $(wildcard docs/*.md)
	@for table in docs/results/*.md; do made=$$(git log -1 --format=%h -- $$table); \
	  echo "$$table is of $$made, $$(git rev-list --count $$made.. -- magrl recipes docs/tables) commits of the code ago"; done

figures: $(FIGURES:%=figure-%)  ## draw the figures, all or FIGURES="place-error"; section-4 after table paper-run

.SECONDARY:  # keep the runs
.SECONDEXPANSION:
table-%: $(VENV)/.installed $$(addsuffix /eval.json,$$(addprefix runs/,$$(RUNS_$$@)))
	$(ONE) docs/tables/grid.py $* --out docs/results

figure-%: $(VENV)/.installed $$(addsuffix /eval.json,$$(addprefix runs/,$$(RUNS_$$@)))
	$(ONE) docs/tables/figures.py $*

pictures: $(VENV)/.installed  ## draw the pictures of the README; two minutes
	$(ONE) docs/tables/pictures.py

# Trainings: name of the run, recipe and options.
define training
runs/$(1)-seed%/eval.json: | $(VENV)/.installed
	$(ONE) recipes/$(2) --seed $$* --out $$(@D)
endef
$(eval $(call training,td3_gradient_guided-fast,td3_gradient_guided.py))
$(eval $(call training,td3_gradient_guided-fast-no-cost,td3_gradient_guided.py --distance-cost 0))
$(eval $(call training,td3_gradient_guided-fast-noise,td3_gradient_guided.py --noise 0.05 0.05 5))
$(eval $(call training,td3-fast,td3_gradient_guided.py --preset fast --no-guided --distance-cost 0))
$(eval $(call training,td3-fast-cost,td3_gradient_guided.py --preset fast --no-guided))
$(eval $(call training,td3_gradient_guided-paper,td3_gradient_guided.py --preset paper))
$(eval $(call training,td3-paper,td3_gradient_guided.py --preset td3-paper))

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*  ## /  \1\t/p' $(MAKEFILE_LIST) | expand -t 14

clean:  ## remove .venv and build outputs
	rm -rf $(VENV) build .coverage *.egg-info .pytest_cache .ruff_cache .mypy_cache

# Install torch first, so that no other package installs another build of it. Modules are compiled at their first import.
CONSTRAINTS := constraints.txt
PIP := $(RUN)/pip install -qq --no-compile --disable-pip-version-check

$(VENV)/.installed: pyproject.toml constraints.txt
	@echo "Installing torch, TorchRL and what the recipes need in $(VENV): one to three minutes"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) $$(grep '^torch==' constraints.txt)
	@$(PIP) -c $(CONSTRAINTS) -e '.[recipes]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@$(PIP) -c $(CONSTRAINTS) -e '.[dev]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	@$(PIP) -c $(CONSTRAINTS) -e '.[docs]'
	@touch $@
