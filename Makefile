# All set-up happens here: each target needs python3 (3.11 or newer), make and a C compiler.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUNS ?= results/pages
METHODS ?= calibrating_mfac regression_mfac rbfnn_mfac ukf_mfac ukf_mpc rbf_pid rbfnn_mfac:published ukf_mfac:published
unexport PYTHONDONTWRITEBYTECODE  # some containers set it, and each of many processes would compile the package anew
NIGHT := PYTHONPATH=tests:benchmarks $(BIN)/python -m night

.PHONY: run check test lowest results board nightly golden lint format tables docs release benchmark lock clean

# Six controllers on six robots, tables, a report with pictures of a rendered run, and what was found: the last lines.
run: $(VENV)/ready
	$(BIN)/servobench compare --plants fmu --seeds 6 --first-seed-on bullet --tasks exp2,circle --no-figures \
	  --controllers calibrating_mfac,regression_mfac,rbfnn_mfac,ukf_mpc,rbfnn_mfac:published,nmpc_calibrated

# For every save: half a minute, without the tests that are marked slow.
check: lint
	$(BIN)/python -m pytest -n auto --dist loadgroup -m "not slow"

# For every change: the unit folders, statistics over runs (closed_loop), processes, compilers and browsers (end_to_end).
test: lint
	$(BIN)/python -m pytest -n auto --dist loadgroup

# The quick tests with the least versions that pyproject.toml allows, in an environment of its own.
lowest:
	$(PYTHON) -m venv build/lowest
	build/lowest/bin/python -m pip install --quiet uv
	build/lowest/bin/uv pip install --quiet --python build/lowest/bin/python --resolution lowest-direct --editable ".[dev]"
	build/lowest/bin/python -m pytest -n auto --dist loadgroup -m "not slow"

# Renew every measured table and picture of the pages: a night. The same call goes on after an interruption;
# ONLY=held_out,rates renews these, RUNS is the folder of the runs. CONTRIBUTING.md lists the studies.
results: $(VENV)/ready
	$(BIN)/python docs/renewal.py $(ONLY) --runs $(RUNS)

# The board of the methods in the pages, build/board/index.html; its submissions go on after an interruption.
board: $(VENV)/ready
	for name in $(METHODS); do $(BIN)/servobench submit $$name --author servobench --resume \
	  --out results/board/$$(echo $$name | tr : .) || exit 1; done
	$(BIN)/servobench leaderboard results/board/* --out build/board

# Too long for every change: whether each block of the first pages runs and all methods do what some do in make test, whether the stored figures of these studies come out again,
# whether FMPy runs exported loops as the harness does, whether a sweep with hostile controllers loses no run, and whether the unit
# tests notice small faults in the code; writes nothing into the pages. Unnoticed faults are listed in results/mutation. The tools are
# in benchmarks/night.
nightly: $(VENV)/ready
	SERVOBENCH_NIGHTLY=1 $(BIN)/python -m pytest $$(grep -rl kit.nightly tests --include 'test_*.py')
	PYTHONPATH=tests:benchmarks $(BIN)/python -m pytest -p conftest benchmarks/night
	$(NIGHT).fuzzing --inputs 1000000
	$(NIGHT).random_calls --calls 10000000
	$(NIGHT).system_loops
	$(NIGHT).file_faults
	$(NIGHT).file_faults --steps --runs 12
	$(NIGHT).file_faults --caches
	$(BIN)/python docs/renewal.py pairs,worlds,claims --check --runs results/nightly
	$(NIGHT).hostile_sweep --runs 10000
	$(NIGHT).signed_folders --folders 10000
	$(NIGHT).kills --kills 100
	$(NIGHT).served_bytes --inputs 100000
	$(NIGHT).served_faults --faults 500
	$(NIGHT).mutation

# Make the golden runs anew (tests/closed_loop/golden_runs.csv), and how far rounding moves them; prints a line for CHANGELOG.md.
golden: $(VENV)/ready
	$(BIN)/python tests/kit/golden.py

lint: $(VENV)/ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

format: $(VENV)/ready
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Write the generated tables of the pages anew from the code and from docs/tables.
tables: $(VENV)/ready
	$(BIN)/python docs/generated_tables.py

# The same, and the pages as a site: build/site/index.html. A broken link or any other warning is an error.
docs: tables
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -b html docs build/site

# Build wheel and source distribution of the tagged commit of this version into dist, check them, install each alone in a fresh
# environment and make a run. REHEARSE=yes takes the checkout as it is.
release: $(VENV)/ready
	$(BIN)/python .ci/release.py $(if $(REHEARSE),--rehearse)

# Write docs/performance.md and its pictures: a quarter of an hour on two quiet processors. AGAINST="0.1.0=/path" adds a checkout.
benchmark: $(VENV)/ready
	@$(BIN)/python -m pip install --quiet --no-build-isolation --editable ".[benchmarks]"
	$(BIN)/python benchmarks/page.py $(if $(AGAINST),--against $(AGAINST))

$(VENV)/ready: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "servobench needs Python 3.11 or newer; name one with make PYTHON=...")'
	@test -d .package/servobench/plant || { echo "git wrote the links in .package/servobench as text files: clone under Linux, macOS or WSL, or with git -c core.symlinks=true clone"; exit 2; }
	@echo "installing, 1 of 3: an environment in $(VENV)"
	@$(PYTHON) -m venv $(VENV) && date +%s > $(VENV)/began
	@echo "installing, 2 of 3: the packages of requirements.lock, a minute or two"
	@$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	@echo "installing, 3 of 3: servobench"
	@$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@echo "installed in $$(($$(date +%s) - $$(cat $(VENV)/began))) s"
	@touch $@

# Renew the lock; it holds hashes and no address of an index (needs uv: pip install uv).
lock:
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --quiet --output-file requirements.lock

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache build dist
