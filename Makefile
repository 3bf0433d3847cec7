# `make train` and `make test` create .venv if necessary. `make help` lists the targets.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
export GOMP_SPINCOUNT ?= 3000

# Runs that the documentation reports. Each has one thread, but for those of GUIDED: `make -j2 paper` uses two cores.
SEEDS := 0 1 2 3 4
TEN := $(SEEDS) 5 6 7 8 9
TWENTY := $(TEN) $(TEN:%=1%)
GUIDED := $(SEEDS:%=runs/td3_gradient_guided-fast-seed%)
ONE_THREAD := $(TWENTY:%=runs/td3_gradient_guided-fast-one-thread-seed%)
PLAIN := $(SEEDS:%=runs/td3-fast-seed%)
NOISY := $(SEEDS:%=runs/td3_gradient_guided-fast-noise-0.05-0.05-5-seed%)
AZORES := $(SEEDS:%=runs/td3_gradient_guided-fast-azores-seed%)
ANYWHERE := $(SEEDS:%=runs/td3_anywhere-fast-seed%)
SAC := $(SEEDS:%=runs/sac-seed%)
PPO := $(SEEDS:%=runs/ppo-seed%)
MEMORY := $(foreach s,0 1 2,runs/td3_recurrent-seed$(s))
AGENTS := $(ONE_THREAD:%=gg_td3=%) $(PLAIN:%=td3=%)
FAIR := anywhere secant kalman run_and_tumble
ORACLES := mean_jacobian parallel geodesic
SWARMS := ga pso afsa ga:flown pso:flown afsa:flown
NOISE_LEVELS := 0 0.02 0.05 0.1
RECIPE := $(RUN)/python recipes

.PHONY: train fly anywhere algorithms paper-run test test-slow check format clean earth globe conditions paper trade bench docs replay mutate help

train: $(VENV)/.installed  ## train Gradient-Guided TD3; about a minute on two cores
	$(RUN)/python recipes/td3_gradient_guided.py $(ARGS)

fly: $(VENV)/.installed  ## fly the pretrained agent from Bergen to Reykjavik; seconds
	$(RECIPE)/fly.py "60.4N 5.3E" "64.1N 21.9W" $(ARGS)

anywhere: $(VENV)/.installed  ## train the agent without a map for all distances; 15 minutes on one core
	OMP_NUM_THREADS=1 $(RECIPE)/td3_anywhere.py --preset far $(ARGS)

test: $(VENV)/.installed-dev  ## run the fast tests, one process per core with one thread each
	OMP_NUM_THREADS=1 $(RUN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal $(ARGS)

test-slow: $(VENV)/.installed-dev  ## run the slow tests (trainings); several minutes
	$(RUN)/python -m pytest -m slow $(ARGS)

mutate: $(VENV)/.installed-mutation  ## run mutation tests of the mathematics; ten minutes on one core
	$(RUN)/mutmut run $(ARGS)
	$(RUN)/mutmut results

check: $(VENV)/.installed-dev  ## check lint, format and types
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/mypy

format: $(VENV)/.installed-dev  ## format the code
	$(RUN)/ruff format .
	$(RUN)/ruff check --fix .

docs: $(VENV)/.installed-docs  ## build the documentation in build/docs
	$(RUN)/python -m sphinx -b html -d build/doctrees -W --keep-going --quiet docs build/docs
	@echo "Open build/docs/index.html"

bench: $(VENV)/.installed-dev  ## run the benchmarks; about nine minutes on two cores
	$(RUN)/python -m benchmarks $(ARGS)
	$(RECIPE)/tables/publish.py docs/performance.md

replay: runs/td3_gradient_guided-fast-seed0/eval.json  ## write a replay page, replay.html in the run folder
	$(RECIPE)/replay.py runs/td3_gradient_guided-fast-seed0 $(ARGS)

# Ablations of the discount factor, the alignment offset and the state, without a cost of distance: eleven trainings, eight
# of which take one minute each.
trade: $(MEMORY:%=%/eval.json)  ## run the ablations
	test -e runs/trade-gamma0.9 || $(RECIPE)/td3_gradient_guided.py --distance-cost 0 --out runs/trade-gamma0.9
	for gamma in 0.97 0.995; do test -e runs/trade-gamma$$gamma || $(RECIPE)/td3_gradient_guided.py \
	  --distance-cost 0 --gamma $$gamma --out runs/trade-gamma$$gamma || exit; done
	for gamma in 0.9 0.97 0.995; do test -e runs/trade-gamma$$gamma-offset0 || $(RECIPE)/td3_gradient_guided.py \
	  --distance-cost 0 --gamma $$gamma --alignment-offset 0 --out runs/trade-gamma$$gamma-offset0 || exit; done
	test -e runs/no-difference || $(RECIPE)/td3_gradient_guided.py --distance-cost 0 --no-observe-difference \
	  --out runs/no-difference
	test -e runs/literal-state || $(RECIPE)/td3_gradient_guided.py --distance-cost 0 --no-observe-difference \
	  --no-observe-heading --out runs/literal-state
	mkdir -p docs/results
	$(RECIPE)/tables/results_table.py $(foreach g,0.9 0.97 0.995,"γ $(g), offset π/4=runs/trade-gamma$(g)") \
	  $(foreach g,0.9 0.97 0.995,"γ $(g), offset 0=runs/trade-gamma$(g)-offset0") > docs/results/trade.md
	$(RECIPE)/tables/results_table.py "heading and difference=runs/trade-gamma0.9" \
	  "without the difference=runs/no-difference" "the paper's eight numbers=runs/literal-state" \
	  $(foreach s,0 1 2,"the eight numbers with a memory (seed $(s))=runs/td3_recurrent-seed$(s)") > docs/results/state.md

# Tables of docs/anywhere.md, from five seeds of preset fast and from the pretrained policy.
earth: $(ANYWHERE:%=%/eval.json)  ## fly agents without a map and other navigators all over the Earth; twenty minutes after five trainings
	mkdir -p docs/results
	$(RECIPE)/tables/earth_table.py anywhere kalman secant parallel geodesic > docs/results/earth.md
	$(RECIPE)/tables/earth_table.py $(ANYWHERE:%=anywhere=%) > docs/results/earth-seeds.md
	$(RECIPE)/tables/earth_table.py map_matching > docs/results/earth-maps.md
	$(RECIPE)/tables/earth_table.py map_matching --map-date 2015-01-01 | tail -n 1 >> docs/results/earth-maps.md
	$(RECIPE)/tables/earth_table.py anywhere kalman secant geodesic --distance-km 700 1000 --max-steps 120 --tasks 2000 \
	  > docs/results/earth-700.md
	$(RECIPE)/tables/earth_table.py anywhere kalman secant geodesic --distance-km 1200 1800 --max-steps 120 --tasks 2000 \
	  > docs/results/earth-1200.md
	$(RECIPE)/tables/publish.py docs/anywhere.md docs/benchmark.md

# Table and figure of docs/conditions.md, from the pretrained policy; make -j2 makes both at once.
conditions: docs/results/conditions.md docs/figures/conditions.png  ## fly navigators under the errors of real vehicles; about seven minutes
	$(RECIPE)/tables/publish.py docs/conditions.md docs/benchmark.md

.PHONY: docs/results/conditions.md docs/figures/conditions.png
docs/results/conditions.md: $(VENV)/.installed
	mkdir -p docs/results
	OMP_NUM_THREADS=1 $(RECIPE)/tables/conditions_table.py > $@

docs/figures/conditions.png: $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/tables/conditions_table.py --tasks 200 --figure $@

# Table of docs/algorithms.md: five seeds of SAC and PPO and the twenty of TD3 that `make paper` has, with one thread.
algorithms: $(foreach run,$(ONE_THREAD) $(SAC) $(PPO),$(run)/eval.json)  ## train TD3, SAC and PPO with several seeds each; an hour on one core
	mkdir -p docs/results
	$(RECIPE)/tables/results_table.py $(ONE_THREAD:%=TD3=%) $(SAC:%=SAC=%) \
	  $(PPO:%=PPO=%) > docs/results/algorithms.md
	$(RECIPE)/tables/publish.py docs/algorithms.md

# The map of the whole Earth, the table of epochs, and the pictures of the flight, from the pretrained policy.
globe: $(VENV)/.installed  ## map where the pretrained agent fails, fly it at five epochs and draw a flight; two minutes
	$(RECIPE)/tables/globe.py --table docs/results/globe.md --figure docs/figures/globe.png
	$(RECIPE)/tables/earth_table.py anywhere --date 1900-01-01 1950-01-01 2000-01-01 2025-01-01 2030-01-01 \
	  > docs/results/epochs.md
	$(RECIPE)/fly.py "60.4N 5.3E" "64.1N 21.9W" --out runs/flight
	cp runs/flight/flight.png docs/figures/flight.png
	$(RECIPE)/fly.py "60.4N 5.3E" "64.1N 21.9W" --noise 0.05 0.05 5 --out runs/flight --animate docs/figures/flight.gif
	$(RECIPE)/tables/publish.py docs/anywhere.md

# Section 4 of the paper. Existing runs are reused. All trainings take forty minutes on two cores (make -j2), everything
# else a few minutes.
paper: $(foreach run,$(GUIDED) $(ONE_THREAD) $(PLAIN) $(NOISY) $(AZORES),$(run)/eval.json)  ## make all tables and figures of the paper's Section 4
	rm -rf runs/comparison runs/comparison-paper-100 runs/comparison-zeta0.001 runs/azores runs/azores-tasks $(NOISE_LEVELS:%=runs/noise-%)
	$(RECIPE)/evaluate.py $(AGENTS) $(SWARMS) $(FAIR) $(ORACLES) --out runs/comparison
	$(RECIPE)/evaluate.py $(AGENTS) $(SWARMS) $(FAIR) $(ORACLES) --tasks paper-100 --out runs/comparison-paper-100
	$(RECIPE)/evaluate.py $(FAIR) $(ORACLES) --zeta 0.001 --out runs/comparison-zeta0.001
	for noise in "0 0 0" "0.02 0.02 2" "0.05 0.05 5" "0.1 0.1 10"; do $(RECIPE)/evaluate.py $(ONE_THREAD:%=gg_td3=%) \
	  $(NOISY:%=gg_td3_noise=%) $(FAIR) $(ORACLES) --noise $$noise --out runs/noise-$${noise%% *} || exit; done
	$(RECIPE)/evaluate.py $(AZORES:%=gg_td3=%) $(FAIR) $(ORACLES) --scenario docs/examples/azores.toml --tasks test-1000 \
	  --out runs/azores
	$(RECIPE)/evaluate.py $(AZORES:%=gg_td3=%) $(FAIR) $(ORACLES) --out runs/azores-tasks
	$(RECIPE)/tables/figures.py --results runs/comparison --gg-td3 $(ONE_THREAD) --td3 $(PLAIN) --out docs/figures
	$(RECIPE)/replay.py runs/td3_gradient_guided-fast-seed0 --gif docs/figures/replay.gif
	mkdir -p docs/results
	for name in comparison comparison-paper-100 comparison-zeta0.001; do cp runs/$$name/table.md docs/results/$$name.md; done
	cp runs/comparison/short.md docs/results/summary.md
	cp runs/azores/short.md docs/results/own-world.md
	cp runs/azores-tasks/short.md docs/results/own-world-tasks.md
	$(RECIPE)/tables/noise_table.py $(NOISE_LEVELS:%=runs/noise-%) --table docs/results/noise.md --figure docs/figures/noise.png
	$(RECIPE)/tables/learning_table.py $(ONE_THREAD:%=gg_td3=%) $(PLAIN:%=td3=%) > docs/results/learning.md
	$(RECIPE)/tables/results_table.py $(ONE_THREAD:%="one thread=%") $(GUIDED:%="two threads=%") --pooled > docs/results/seeds.md
	$(RECIPE)/tables/results_table.py $(AZORES) --each > docs/results/azores.md
	$(RECIPE)/tables/path_loss.py $(ONE_THREAD:%=gg_td3=%) $(PLAIN:%=td3=%) $(FAIR) $(ORACLES) > docs/results/path_loss.md
	$(RECIPE)/tables/probe_sweep.py > docs/results/probe_sweep.md
	$(RECIPE)/tables/random_boxes.py > docs/results/random_boxes.md
	$(RECIPE)/tables/publish.py README.md docs/reproduction.md docs/own_data.md

# The training of Table 1 (docs/paper_run.md): table, curves, and both agents on the tasks of the other tables.
PAPER_RUNS := runs/td3_gradient_guided-paper-seed0 runs/td3-paper-seed0
FAST_RUNS := runs/td3_gradient_guided-fast-one-thread-seed0 runs/td3-fast-seed0
COMPARED := gg_td3=$(word 1,$(PAPER_RUNS)) td3=$(word 2,$(PAPER_RUNS)) \
  "policy:Gradient-Guided TD3, preset fast=$(word 1,$(FAST_RUNS))/policy.pt" \
  "policy:TD3, preset fast=$(word 2,$(FAST_RUNS))/policy.pt"
paper-run: $(foreach run,$(PAPER_RUNS) $(FAST_RUNS),$(run)/eval.json)  ## train both agents of Table 1 whole; three to six hours on two cores (make -j2)
	$(RECIPE)/tables/paper_run.py "Gradient-Guided TD3=$(word 1,$(PAPER_RUNS))" "TD3=$(word 2,$(PAPER_RUNS))" \
	  "Gradient-Guided TD3, preset fast=$(word 1,$(FAST_RUNS))" "TD3, preset fast=$(word 2,$(FAST_RUNS))" \
	  --figure docs/figures/paper-run.png > docs/results/paper-run.md
	rm -rf runs/paper-run runs/paper-run-100
	$(RECIPE)/evaluate.py $(COMPARED) --out runs/paper-run
	$(RECIPE)/evaluate.py $(COMPARED) --tasks paper-100 --out runs/paper-run-100
	cp runs/paper-run/table.md docs/results/paper-run-1000.md
	cp runs/paper-run-100/table.md docs/results/paper-run-100.md
	$(RECIPE)/tables/publish.py docs/paper_run.md

runs/td3_gradient_guided-paper-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/td3_gradient_guided.py --preset paper --precision bfloat16 --seed $*

runs/td3-paper-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/td3_gradient_guided.py --preset td3-paper --precision bfloat16 --seed $*

runs/td3_gradient_guided-fast-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=2 $(RECIPE)/td3_gradient_guided.py --seed $*

runs/sac-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/sac.py --seed $*

runs/ppo-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/ppo.py --seed $*

runs/td3_gradient_guided-fast-one-thread-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/td3_gradient_guided.py --seed $* --out $(@D)

runs/td3_gradient_guided-fast-noise-0.05-0.05-5-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/td3_gradient_guided.py --noise 0.05 0.05 5 --seed $*

runs/td3_gradient_guided-fast-azores-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/td3_gradient_guided.py --scenario docs/examples/azores.toml --seed $*

runs/td3_anywhere-fast-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/td3_anywhere.py --seed $*

runs/td3-fast-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/td3_gradient_guided.py --preset td3-fast --seed $*

runs/td3_recurrent-seed%/eval.json: | $(VENV)/.installed
	OMP_NUM_THREADS=1 $(RECIPE)/td3_recurrent.py --seed $*

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*  ## /  \1\t/p' $(MAKEFILE_LIST) | expand -t 14

clean:  ## remove .venv and build outputs
	rm -rf $(VENV) build mutants .coverage *.egg-info .pytest_cache .ruff_cache .mypy_cache

# Install torch first, so that no other package installs another build of it.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN)/pip install --quiet --disable-pip-version-check $$(grep '^torch==' constraints.txt)
	$(RUN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[recipes]'
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(RUN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(RUN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	touch $@

$(VENV)/.installed-mutation: $(VENV)/.installed-dev
	$(RUN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[mutation]'
	touch $@
