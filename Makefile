# All set-up happens here: each target needs python3 (3.11 or newer), make and a C compiler.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
UNIT := tests/plant tests/controllers tests/fmus tests/harness
NIGHTLY ?= results/nightly

.PHONY: run check test nightly lint format docs figures benchmark lock clean

run: $(VENV)/ready
	$(BIN)/servobench compare --plants bullet,fmu --mismatch moderate \
	  --controllers rbfnn_mfac_plus,rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid,constant,calibrated,nmpc_calibrated

# For every save: half a minute.
check: lint
	$(BIN)/python -m pytest -n auto $(UNIT)

# For every change: the unit folders, statistics over runs (closed_loop), processes, compilers and browsers (end_to_end).
test: lint
	$(BIN)/python -m pytest -n auto

# Too long for every change: hours. The same call goes on after an interruption; docs/experiments.md names its last figures.
nightly: $(VENV)/ready
	PYTHONPATH=tests $(BIN)/python docs/nightly.py $(NIGHTLY)

lint: $(VENV)/ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

format: $(VENV)/ready
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Write the generated tables of the pages anew from the code.
docs: $(VENV)/ready
	$(BIN)/python docs/generated_tables.py

# Draw the README's pictures anew from committed seeds: the comparison on rendered images takes most of the minutes.
figures: $(VENV)/ready
	$(BIN)/python docs/readme_pictures.py docs/pictures

# Write docs/performance.md and its pictures: a quarter of an hour on two quiet processors. AGAINST="0.1.0=/path" adds a checkout.
benchmark: $(VENV)/ready
	$(BIN)/python benchmarks/page.py $(if $(AGAINST),--against $(AGAINST))

$(VENV)/ready: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "servobench needs Python 3.11 or newer; name one with make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

# Renew the lock; it holds hashes and no address of an index (needs uv: pip install uv).
lock:
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --quiet --output-file requirements.lock

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache build dist
