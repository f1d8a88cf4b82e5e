# Every habit of the project; `make` alone lists them. CI runs nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# More flags for pip, for instance --extra-index-url https://download.pytorch.org/whl/cpu for a PyTorch without CUDA.
PIP_FLAGS ?=

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-lowest test-slow format lint type check docs bench reliability figures comparisons benchmark benchmark-smoke clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(VENV)/.installed: setup.cfg constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed (setup.cfg); set PYTHON=... ")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check $(PIP_FLAGS) -c constraints.txt -e '.[tests]'
	@touch $@

setup: $(VENV)/.installed  ## make .venv and install the package with its pinned dependencies

demo: setup  ## collect, pretrain, train PPO, draw: the whole product in about ten minutes, into demo/
	$(BIN)/sb3-abisim demo -o demo

# In random order, over all processors, with one thread each.
test: setup  ## the tests that CI runs
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto

# In an environment of its own, whose other packages are the newest that the lowest ones go with.
test-lowest: $(VENV)-lowest/.installed  ## the tests with the lowest versions that setup.cfg allows, into .venv-lowest/
	OMP_NUM_THREADS=1 $(VENV)-lowest/bin/python -m pytest -n auto

$(VENV)-lowest/.installed: setup.cfg constraints-lowest.txt
	$(PYTHON) -m venv $(VENV)-lowest
	$(VENV)-lowest/bin/python -m pip install --disable-pip-version-check $(PIP_FLAGS) -c constraints-lowest.txt -e '.[tests]'
	@touch $@

test-slow: setup  ## the tests that take minutes
	$(BIN)/python -m pytest -m slow

format: setup  ## rewrite the code in the project's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

lint: setup  ## format and lint, without changing anything
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

type: setup  ## mypy in strict mode
	$(BIN)/python -m mypy sb3_abisim

check: lint type test  ## all of the above that must be green

# The source folder is the repository, since the pages link into all of it.
docs: setup  ## the pages of docs/ as a site with the API's reference, into site/; a warning is an error
	$(BIN)/python -m sphinx -b html -W --keep-going -c docs -d build/doctrees . site

bench: setup  ## measure speed side by side with the alternatives, into benchmarks/results/
	$(BIN)/python -m benchmarks.bench_envs
	$(BIN)/python -m benchmarks.bench_pretraining
	$(BIN)/python -m benchmarks.bench_memory
	$(BIN)/python -m benchmarks.bench_scale
	$(BIN)/python -m benchmarks.bench_frozen
	$(BIN)/python -m benchmarks.bench_auxiliary
	$(BIN)/python -m benchmarks.bench_scan_nav
	$(BIN)/python -m benchmarks.bench_malloc
	$(BIN)/python -m benchmarks.bench_collect

reliability: setup  ## damaged and hostile files, kills, steps and NaN, counted, into docs/limits.md; half an hour
	$(BIN)/python -m benchmarks.reliability --seed 0

figures: setup  ## make every figure of docs/figures.md again from the committed encoders; about a quarter of an hour
	$(BIN)/sb3-abisim analyze all --images docs/images --numbers benchmarks/results

# The folders of committed runs whose curves are in docs/results.md: of evaluations, and of training episodes.
COMPARISONS := distractor_frozen distractor_finetuned_methods pointmaze_finetuned nav2d_dqn nav2d_dqn_long
TRAINING_COMPARISONS := distractor_frozen_longer distractor_frozen_early distractor_frozen_7m distractor_finetuned_more \
	nav2d_ppo_frozen distractor_frozen_layer minigrid_fourrooms nav2d_random_goal
# Compared with the runs of nav2d_dqn_target.
NAV2D_VANILLA := vanilla, 10,000=benchmarks/results/comparison/nav2d_dqn/runs/Nav2D-v0/vanilla-cd2b7a74

comparisons: setup  ## plot every curve of docs/results.md again from the committed runs; a minute
	@draw() { \
		name=$$1; shift; \
		$(BIN)/sb3-abisim benchmark report benchmarks/results/comparison/$$name "$$@" -o build/comparisons/$$name && \
		cp build/comparisons/$$name/curves.png docs/images/comparison-$$name.png; \
	}; \
	for name in $(COMPARISONS); do draw $$name || exit 1; done; \
	for name in $(TRAINING_COMPARISONS); do draw $$name --source training || exit 1; done; \
	draw nav2d_dqn_target "$(NAV2D_VANILLA)" && \
	draw distractor_vanilla_longer benchmarks/results/comparison/distractor_finetuned_more --source training

benchmark: setup  ## the paper's comparison with its budgets, days on one machine, into benchmark/; resumes
	$(BIN)/sb3-abisim benchmark -o benchmark

# Budgets that show that everything works, and nothing about the methods. Of each thing the least that gives every part
# of the report: two runs for intervals, one encoder for both (on the SSI encoder that it starts from), a baseline, clips.
SMOKE := --env Nav2D-v0 DistractorPointMaze-v0 --methods abisim vanilla --seeds 0 1 --encoder-seeds 0 \
	--n-transitions 2000 -n 1024 --eval-freq 256 --eval-episodes 3 --n-eval-envs 3 --final-episodes 4 --device cpu \
	--pretrain-params n_updates:20 log_interval:10 checkpoint_interval:10 batch_size:64 \
	--params dqn.learning_starts:100 ppo.n_envs:4 ppo.n_steps:64 ppo.batch_size:64 ppo.n_epochs:2

benchmark-smoke: setup  ## the same kinds of jobs and report with tiny budgets, in minutes, into benchmark-smoke/
	$(BIN)/sb3-abisim benchmark -o benchmark-smoke $(SMOKE)

clean:  ## remove the environment and caches
	rm -rf $(VENV) $(VENV)-lowest .pytest_cache .mypy_cache .ruff_cache build site docs/api *.egg-info
