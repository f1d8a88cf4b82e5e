# Every habit of the project; `make` alone lists them. CI runs nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# More flags for pip, for instance --extra-index-url https://download.pytorch.org/whl/cpu for a PyTorch without CUDA.
PIP_FLAGS ?=

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-envs test-lowest test-slow format lint type check docs bench times reliability figures comparisons benchmark benchmark-smoke clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(VENV)/.installed: setup.cfg constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed (setup.cfg); set PYTHON=... ")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check $(PIP_FLAGS) -c constraints.txt -e '.[tests]'
	@touch $@

setup: $(VENV)/.installed  ## make .venv and install the package with its pinned dependencies

demo: setup  ## collect, pretrain, train PPO, draw: the whole product in about three minutes, into demo/
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

# The tests that need more packages than [tests] has.
TESTS_OF_OTHERS := tests/data/test_vectorized.py tests/envs/test_vector_env_adapter.py tests/networks/test_timm_backbones.py

# dm_control does not load beside MuJoCo 4. It renders through EGL (on Debian, libegl1).
test-envs: $(VENV)-envs/.installed  ## the three commands on environments of other packages, and tests with these and timm; half an hour
	OMP_NUM_THREADS=1 $(VENV)-envs/bin/python -m pytest $(TESTS_OF_OTHERS)
	MUJOCO_GL=egl $(VENV)-envs/bin/python -m benchmarks.any_pixels

$(VENV)-envs/.installed: setup.cfg
	$(PYTHON) -m venv $(VENV)-envs
	$(VENV)-envs/bin/python -m pip install --disable-pip-version-check $(PIP_FLAGS) -e . \
		ale-py 'gymnasium[box2d]' dm_control minigrid opencv-python-headless pytest shimmy timm 'mujoco<4'
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
	$(BIN)/python -m benchmarks.bench_ahead
	$(BIN)/python -m benchmarks.bench_memory
	$(BIN)/python -m benchmarks.bench_scale
	$(BIN)/python -m benchmarks.bench_frozen
	$(BIN)/python -m benchmarks.bench_finetuning
	$(BIN)/python -m benchmarks.bench_auxiliary
	$(BIN)/python -m benchmarks.bench_scan_nav
	$(BIN)/python -m benchmarks.bench_malloc
	$(BIN)/python -m benchmarks.bench_collect
	$(BIN)/python -m benchmarks.headline

# From nothing: data and encoders are made inside, each job on one thread, one job at a time. One evaluation, at the end, since
# the curves are those of the training episodes. What begins untrained has more steps, as long as the others take with all they
# need. With TIMES=FOLDER and the same flags, a run that was stopped goes on.
TIMES := times
TIMES_FLAGS := --seeds 0 1 2 --eval-episodes 20 --n-eval-envs 10 --final-episodes 50 --device cpu --threads 1 --jobs 1 --no-report
TIMES_PRETRAINED := -n 131072 --eval-freq 131072 --methods abisim abisim,frozen goal_progress,frozen
TIMES_SCRATCH := -n 655360 --eval-freq 655360 --methods vanilla vanilla,auxiliary=ssi drq
TIMES_DISTRACTOR := --env DistractorPointMaze-v0 \
	--params ppo.n_steps:128 ppo.batch_size:256 ppo.n_epochs:4 ppo.learning_rate:3e-4
TIMES_NAV2D := --env Nav2D-v0 --algo ppo

times: setup  ## minutes from nothing to a trained agent, by method, into times/; hours; resumes
	$(BIN)/sb3-abisim benchmark -o $(TIMES)/distractor $(TIMES_FLAGS) $(TIMES_PRETRAINED) $(TIMES_DISTRACTOR)
	$(BIN)/sb3-abisim benchmark -o $(TIMES)/nav2d $(TIMES_FLAGS) $(TIMES_PRETRAINED) $(TIMES_NAV2D)
	$(BIN)/sb3-abisim benchmark -o $(TIMES)/distractor_scratch $(TIMES_FLAGS) $(TIMES_SCRATCH) $(TIMES_DISTRACTOR)
	$(BIN)/sb3-abisim benchmark -o $(TIMES)/nav2d_scratch $(TIMES_FLAGS) $(TIMES_SCRATCH) $(TIMES_NAV2D)
	$(BIN)/python -m benchmarks.times $(TIMES)/distractor $(TIMES)/distractor_scratch $(TIMES)/nav2d $(TIMES)/nav2d_scratch

reliability: setup  ## damaged and hostile files, kills, steps and NaN, counted, into docs/limits.md; half an hour
	$(BIN)/python -m benchmarks.reliability --seed 0

figures: setup  ## make every figure of docs/figures.md again from the committed encoders; about a quarter of an hour
	$(BIN)/sb3-abisim analyze all --images docs/images --numbers benchmarks/results

comparisons: setup  ## fill the tables and plot the curves of the results pages again from the committed runs; a minute
	$(BIN)/python -m benchmarks.results_page --figures

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
	rm -rf $(VENV) $(VENV)-envs $(VENV)-lowest .pytest_cache .mypy_cache .ruff_cache build site docs/api *.egg-info
