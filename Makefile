# make demo   sets everything up in .venv and runs the whole chain on the built-in face task, three to four minutes
# make test   sets up, lints and runs the tests, ten minutes; installs nothing outside of .venv, 3.3 GB there with torch for the processor
# make test-slow  runs what takes longer: pages of the docs and examples from beginning to end, packages, kills; as CI does
# make docs   writes the documentation with a search as pages of build/site, which load nothing from elsewhere
# make consumers  installs the programs that tests give exported files to, from the system's packages, as CI does
# make test-arithmetic  runs the commands of the docs with the arithmetic of a plain processor, two minutes
# make test-pythons  installs and tests the core with every other Python that is found, four minutes each
# make dist   builds sdist and wheel, installs the wheel with every Python that is found and runs the demo with it, ten minutes
# make fuzz   reads 100,000 damaged files, some ten minutes; the result goes to docs/soak
# make coverage  measures the lines and branches that the tests take, an hour
# make mutation  changes the core's code in a thousand small ways and counts what its tests notice; to docs/soak
# make soak   all long runs, a night on two cores: random whole runs, many seeds, kills, then fuzz and mutation; each
#             also alone, as make soak-runs, soak-seeds and soak-kills; dated results go to docs/soak; with AMOUNT=N
#             fuzz, mutation (of each module) and each of these do N inputs, mutants, runs, seeds, kills or plans
# make soak-promise  makes 2,000 random plans of effects and looks whether they keep what they promise, a minute or two
#             what is interrupted (also fuzz, mutation and coverage) goes on when it is started again at the same commit
# make clean  takes all of it away again
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Two BLAS pools on two shared cores spin against each other; one thread each is the fast setting there.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export OMP_WAIT_POLICY ?= PASSIVE

# Long runs do so many things at once
JOBS ?= 2
LONG := $(BIN)/python -m pytest -p tests.conftest -p benchmarks.soak.long_runs -m long -n $(JOBS) --maxschedchunk 1 \
	--max-worker-restart 100 -o tmp_path_retention_policy=failed --page docs/soak

.PHONY: demo test test-slow docs dist consumers setup system-programs test-arithmetic test-pythons coverage mutation lint fuzz soak soak-benchmarks soak-runs soak-seeds soak-kills soak-promise clean

# setuptools announces every editable install with a warning
INSTALL := PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable

$(BIN)/.environment: pyproject.toml constraints.txt
	@tools/environment.sh "$(PYTHON)" $(VENV)
	@touch $@

$(BIN)/.ready: $(BIN)/.environment
	@$(INSTALL) .
	@touch $@

demo: $(BIN)/.ready
	$(BIN)/python examples/demo.py

# What the tests need: with what reads exported files, models of robots and the light-transport simulator, or else without.
# The models come alone: what runs them is not needed.
MODELS := dm-control==1.0.50 gymnasium-robotics==1.4.2 robosuite==1.5.2
$(BIN)/.test: $(BIN)/.environment
	@echo "Adding what tests need, also the readers of exported files and the light-transport simulator: once, 0.5 GB"
	@($(INSTALL) '.[test,transport,consumers]' && $(BIN)/python -m pip install --quiet --no-deps $(MODELS)) \
		|| (echo "Not all could be installed; tests that need more are skipped" && $(INSTALL) '.[test]')
	@touch $@ $(BIN)/.ready

# What documentation and releases need besides
$(BIN)/.dev: $(BIN)/.test
	@$(INSTALL) '.[dev]'
	@touch $@

# The variable leaves out an announcement of the theme's makers
docs: $(BIN)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "build/site/index.html"

# Programs of the system's packages: in CI and on demand alone. Tests that miss one are skipped and say why.
system-programs: $(BIN)/.test
	@tools/install-llvm.sh $(BIN)/python
	@tools/install-consumers.sh

consumers: system-programs

# All that the tests need
setup: $(BIN)/.test $(if $(filter true,$(CI)),system-programs)

PYTEST := $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

test: setup
	$(BIN)/python -m ruff check --no-cache .
	$(PYTEST) -m 'not slow and not long'

# Whole pages of the docs, examples, packages in environments of their own, kills: CI runs them too
test-slow: setup
	$(PYTEST) -m 'slow and not long'

# Every kind of processor rounds in its own way, and a small run ends elsewhere on each: this is another one
test-arithmetic: $(BIN)/.test
	ATEN_CPU_CAPABILITY=default MKL_CBWR=COMPATIBLE \
		NUMBA_CPU_NAME=generic NUMBA_CACHE_DIR="$(CURDIR)/build/numba-generic" \
		$(BIN)/python -m pytest tests/docs/test_docs_run.py

# What every other Python that is found makes of the installation and of the core
test-pythons: $(BIN)/.test
	tools/test-pythons.sh $(BIN)/python

dist: $(BIN)/.dev
	tools/dist.sh $(BIN)/python

# The suite with every line and branch that it takes; what numba compiles, apart, in a run without the compiler
KERNELS := NUMBA_DISABLE_JIT=1 $(BIN)/python -m coverage
coverage: $(BIN)/.dev
	$(BIN)/python -m coverage erase
	$(BIN)/python tools/coverage_pieces.py
	@mkdir -p build
	$(KERNELS) run --rcfile=/dev/null --branch --source=lidardesign --data-file=build/kernels.coverage \
		-m pytest -W ignore::RuntimeWarning tests/density/test_splines.py tests/density/test_frames.py \
		tests/density/test_visibility.py tests/scenes/test_raycast.py tests/rays/test_groups.py
	$(KERNELS) report --rcfile=/dev/null --data-file=build/kernels.coverage --include='*kernels.py'
	$(BIN)/python -m coverage report --fail-under=95

# Small changes of the core's code, and how many of them its tests notice: half an hour
mutation: $(BIN)/.test
	$(BIN)/python tools/mutation.py --out docs/soak/mutation-$$(date -u +%F).md $(if $(AMOUNT),--sample $(AMOUNT))

lint: $(BIN)/.test
	$(BIN)/python -m ruff check --no-cache .

fuzz: $(BIN)/.test
	$(LONG) benchmarks/soak/fuzz.py --amount $(or $(AMOUNT),100000)

soak: soak-benchmarks soak-runs soak-seeds soak-kills fuzz mutation

# Every benchmark once, as small as it can be
soak-benchmarks: $(BIN)/.test
	$(BIN)/python -m pytest -m long tests/docs

# 520 runs of random configurations, some 200 of them whole: no fault, every constraint kept, the same bytes when done again
soak-runs: $(BIN)/.test
	$(LONG) benchmarks/soak/runs.py --amount $(or $(AMOUNT),520)

# The face and the arm at draft and standard from 20 seeds each: every one learns well enough
soak-seeds: $(BIN)/.test
	$(LONG) benchmarks/soak/seeds.py --amount $(or $(AMOUNT),20)

# Learning, fitting and evaluating are killed at all steps and random moments: what is left can be read, and going on
# repeats the bytes; and every command ends with its signals. Processes are forked, which workers with threads cannot do.
soak-kills: $(BIN)/.test
	$(LONG) -n 0 benchmarks/soak/kills.py --amount $(or $(AMOUNT),2300)

# 2,000 random plans: nothing that is skipped changes more than is tolerated
soak-promise: $(BIN)/.test
	$(LONG) benchmarks/soak/promise.py --amount $(or $(AMOUNT),2000)

clean:
	rm -rf $(VENV) build dist runs *.egg-info
