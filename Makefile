# make demo   sets everything up in .venv and runs the whole chain on the built-in face task, about two minutes
# make test   sets up, lints and runs the tests, a few minutes; also installs the light-transport simulator, 200 MB
# make fuzz   reads 100,000 damaged files, an hour on two cores; the result goes to docs/soak
# make clean  takes all of it away again
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Two BLAS pools on two shared cores spin against each other; one thread each is the fast setting there.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export OMP_WAIT_POLICY ?= PASSIVE

.PHONY: demo test lint fuzz clean

$(BIN)/.ready: pyproject.toml constraints.txt
	@echo "Setting up $(VENV): once, a minute or more"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --upgrade pip
	@# setuptools announces every editable install with a warning
	@PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: $(BIN)/.ready
	$(BIN)/python examples/demo.py

$(BIN)/.transport: $(BIN)/.ready
	@echo "Adding the light-transport simulator: once, 200 MB"
	@PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[transport]' \
		&& touch $@ || echo "It could not be installed; its tests are skipped"
	@tools/install-llvm.sh $(BIN)/python

test: $(BIN)/.ready $(BIN)/.transport
	$(BIN)/python -m ruff check .
	$(BIN)/python -m pytest

lint: $(BIN)/.ready
	$(BIN)/python -m ruff check .

fuzz: $(BIN)/.ready
	PYTHONPATH=tests $(BIN)/python tests/fuzz/campaign.py --inputs 100000 --out docs/soak

clean:
	rm -rf $(VENV) build dist runs *.egg-info
