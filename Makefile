PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Python, then ROS, then the messages, each behind a stamp of its own: what needs no ROS does not wait for it, and the
# messages, which take a minute to compile, are compiled again only when they change. Kernels wait for Python alone, so
# that they are compiled beside the messages.
READY := $(VENV)/.ready
KERNELS_READY := $(VENV)/.ready-kernels
ROS_READY := $(VENV)/.ready-ros
MSGS_READY := $(VENV)/.ready-msgs
COLCON_VENV := .venv-colcon
COLCON_READY := $(COLCON_VENV)/.ready

WARM_UP := $(BIN)/python -c 'from gsseg_core.warm_up import warm_up; warm_up(say=print)'

INSTALLED := setup.py package.xml $(wildcard config/* foxglove/* launch/* resource/* rviz/* scripts/* sros2/*)
KERNELS := $(shell grep -rlE --include='*.py' 'numba|gsseg_core.kernels' gsseg_core)
MSGS := $(wildcard msg_defs/*.* msg_defs/action/* msg_defs/msg/* msg_defs/srv/*)

# Of tests that run beside each other: those that start nodes wait more than they work.
TEST_WORKERS ?= 4

# Bytecode of what is imported, whatever the environment has to say: without it a node takes 3.2 s of processor time to
# import what it needs, in place of 1.0. And none of what nobody imports: pip reads the second one the other way round,
# 0 is --no-compile, here and where it builds.
unexport PYTHONDONTWRITEBYTECODE
export PIP_NO_COMPILE = 0

# Both builders of the messages obey it; without it one of them compiles file after file.
export CMAKE_BUILD_PARALLEL_LEVEL ?= $(shell nproc 2>/dev/null || echo 1)

# Beside each other, threads of NumPy's matrix products that wait would take the cores from others, so there is one.
run-tests run-fast-tests: export OPENBLAS_NUM_THREADS = 1

# Targets that `make test` makes beside the tests, after lint: tests wait for much, and leave a good part of two cores.
BESIDE ?=

.PHONY: help demo demo-local view check house environments test lint run-fast-tests run-tests docs colcon results robustness bench clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{ printf "%-16s %s\n", $$1, $$2 }'

demo: $(KERNELS_READY) $(ROS_READY) $(MSGS_READY)  ## segment a small scene with known truth through the ROS 2 node
	$(BIN)/python -m gsseg_ros.demo --out demo_out

demo-local: $(KERNELS_READY)  ## the same scene without ROS, by the command line
	$(BIN)/gsseg demo --out demo_out

view: $(KERNELS_READY)  ## segment a small scene and look at it in the browser; Ctrl-C ends it
	$(BIN)/gsseg demo --out demo_out
	$(BIN)/gsseg view demo_out/scene/scene.ply --segmentation demo_out/segmented/segmentation.npz \
		--data demo_out/scene --open

check: $(READY) $(ROS_READY) $(MSGS_READY)  ## lint, check the types, the order of the rooms and all that starts no process: about a minute
	@$(MAKE) --no-print-directory --jobs=2 --keep-going lint run-fast-tests

house: $(KERNELS_READY)  ## print what the house measures, with the bar beside each; HOUSE=--times runs all tests, too
	$(BIN)/python benchmarks/house.py $(HOUSE)

test: $(READY)  ## lint, check the types and run the tests
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target $(KERNELS_READY) $(MSGS_READY)
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target --keep-going run-tests lint $(BESIDE)

environments: $(READY) $(COLCON_READY)

lint: | $(ROS_READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

run-fast-tests: $(KERNELS_READY)
	$(BIN)/python -m pytest -q -W error --numprocesses=2 --dist=worksteal -m 'not processes'

# Once, before the workers: each of them would compile all tests, all at the same time.
run-tests:
	@$(BIN)/python -m pytest -q --collect-only >/dev/null || true
	$(BIN)/python -m pytest -W error --durations=20 --numprocesses=$(TEST_WORKERS) --dist=loadfile --no-loadscope-reorder

docs: $(READY)  ## build the documentation into site/index.html, and refuse links that lead nowhere
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

colcon: $(COLCON_READY)  ## build both packages with colcon, as a robot does, and run the node that comes out
	.ci/colcon $(COLCON_VENV) .colcon

results: $(READY)  ## measure again what docs/results.md shows
	$(BIN)/python benchmarks/results.py

robustness: $(READY)  ## measure again what docs/robustness.md shows: masks wrong in every way, at every strength
	$(BIN)/python benchmarks/robustness.py

bench: $(READY)  ## measure speed, memory and peers: BENCHMARK.md, compared with the last BENCHMARK.json (25 minutes)
	$(BIN)/python benchmarks/bench.py

clean:  ## remove the environments, the caches, what was built and the demo's output
	rm -rf $(VENV) $(COLCON_VENV) .venv-peers .colcon build install log demo_out results_out site gsseg.egg-info
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find benchmarks gsseg_core gsseg_ros tests -name __pycache__ -prune -exec rm -rf {} +

define check-python
@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 10) <= v <= (3, 14) else \
	"gsseg needs Python 3.10 to 3.14, and $(PYTHON) is %d.%d: name another with `make PYTHON=...`" % v)'
endef

define check-ros
@test "$$(uname -s -m)" = "Linux x86_64" || \
	{ echo 'ROS 2 comes as wheels for Linux on x86-64 only; `make demo-local` does without it' >&2; exit 1; }
@command -v g++ >/dev/null && command -v cmake >/dev/null || \
	{ echo 'compiling the ROS messages needs gcc, g++ and cmake' >&2; exit 1; }
endef

# pip and setuptools first: the pinned pip finds what there is in a third of the processor time that the one of Python 3.11
# takes, and the build uses the pinned setuptools, too.
$(READY): $(INSTALLED) pyproject.toml constraints.txt
	$(check-python)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt pip setuptools
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[dev]'
	touch $@

# Compiled before the first picture, so that it does not wait for them; and once, not by each test that needs them.
$(KERNELS_READY): $(KERNELS) | $(READY)
	$(WARM_UP)
	touch $@

$(ROS_READY): setup.py constraints.txt | $(READY)
	$(check-ros)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[dev,ros]'
	touch $@

# The build has an environment of its own, with versions of the generators that nothing else should see. pip hands the
# constraints on to it only through its own environment variables; which of the two depends on pip's age.
$(MSGS_READY): $(MSGS) | $(ROS_READY)
	@echo 'compiling the ROS messages, which takes a minute'
	PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt \
		$(BIN)/python -m pip install --quiet --no-deps --force-reinstall ./msg_defs
	touch $@

# As on a robot: versions of Ubuntu 24.04 where it has any.
$(COLCON_READY): .ci/colcon-requirements.txt .ci/ubuntu-24.04.txt constraints.txt
	$(check-python)
	$(check-ros)
	$(PYTHON) -m venv $(COLCON_VENV)
	sed -n 's/^\([a-z0-9]*==\).*/^\1/p' .ci/ubuntu-24.04.txt | grep -v -f - constraints.txt | \
		cat - .ci/ubuntu-24.04.txt > $(COLCON_VENV)/constraints.txt
	$(COLCON_VENV)/bin/python -m pip install --quiet --constraint constraints.txt pip
	$(COLCON_VENV)/bin/python -m pip install --quiet --constraint $(COLCON_VENV)/constraints.txt \
		-r .ci/colcon-requirements.txt
	touch $@
