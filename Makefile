# A fresh clone needs `make demo` or `make test`, and nothing before it.
#
# install       .venv with everything of requirements.txt, real ROS 2 included where there is none (default)
# demo          install, then the demonstration
# test          install, then style, types and tests
# test-oldest   the tests without ROS, in .venv-oldest with the lowest versions that setup.py allows
# lint, format  style and types: tell, mend
# lock          write requirements.txt and constraints-oldest.txt from setup.py; LOCK=--upgrade takes newer versions
# bench         measure ours against GTSAM, g2o and python-graphslam into docs/benchmarks.md and accuracy.md; hours
# clean         remove what these made

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
SOURCES := $(shell find graph_slam_ros -name '*.py')

# Is a ROS installation sourced? One in a virtual environment (.venv, when it is activated) does not count.
SYSTEM_ROS := $(shell $(PYTHON) -c 'import sys; from importlib.util import find_spec; ros = find_spec("rclpy"); \
  print("yes" if ros and (sys.prefix == sys.base_prefix or not ros.origin.startswith(sys.prefix)) else "")')

# The ROS wheels set both at the start of Python, and a child in another environment would take them for its own.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
ifeq ($(SYSTEM_ROS),)
unexport LD_LIBRARY_PATH
endif

.PHONY: install demo test test-oldest lint format lock bench clean
.DELETE_ON_ERROR:

install: $(VENV)/interfaces.stamp $(VENV)/kernels.stamp

demo: install
	@$(BIN)/graph_slam demo

test: install lint
	$(BIN)/python -m pytest -q

lint: $(VENV)/package.stamp
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: $(VENV)/package.stamp
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

$(VENV)/venv.stamp:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	  { echo 'graph_slam_ros: needs Python 3.10 or newer: make PYTHON=python3.12'; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo 'graph_slam_ros: needs the venv module: sudo apt install python3-venv'; exit 1; }
	$(PYTHON) -m venv $(if $(SYSTEM_ROS),--system-site-packages) $(VENV)
	@touch $@

# The lines of requirements.txt that are for ROS alone are those for one kind of machine.
without = awk '/^[^ \#]/ {keep = !/$(1)/} keep' requirements.txt > $(VENV)/requirements.txt

$(VENV)/requirements.stamp: requirements.txt $(VENV)/venv.stamp
	@echo 'graph_slam_ros: installing into $(VENV), a minute or two the first time'
ifeq ($(SYSTEM_ROS),)
	@$(PIP) install --quiet --require-hashes -r requirements.txt || { \
	  echo 'graph_slam_ros: the ROS wheels cannot be installed, see above: going on without ROS'; \
	  $(call without,platform_machine) && $(PIP) install --quiet --require-hashes -r $(VENV)/requirements.txt; }
else
	@$(call without,platform_machine|^numpy==|^pandas==) && \
	  $(PIP) install --quiet --require-hashes --no-deps -r $(VENV)/requirements.txt
endif
	@touch $@

# The messages of an installed ROS are compiled for the major version of NumPy that it came with, and pandas must fit.
SAME_NUMPY = import numpy; print("numpy<%d" % (int(numpy.__version__.split(".")[0]) + 1))
$(VENV)/package.stamp: setup.py setup.cfg pyproject.toml graph_slam_ros/__init__.py $(VENV)/requirements.stamp
	@$(PIP) install --quiet --no-build-isolation \
	  $(if $(SYSTEM_ROS),-e '.[evaluate]' "$$($(PYTHON) -c '$(SAME_NUMPY)')",--no-deps -e .)
	@touch $@

# Without the stamp it is tried, and what is missing is said, every time.
$(VENV)/interfaces.stamp: $(VENV)/package.stamp
	@if $(BIN)/python -m graph_slam_ros.ros.generate_interfaces; then touch $@; fi

$(VENV)/kernels.stamp: $(SOURCES) $(VENV)/package.stamp
	@$(BIN)/graph_slam warmup
	@touch $@

$(VENV)-oldest/stamp: constraints-oldest.txt setup.py setup.cfg pyproject.toml
	$(PYTHON) -m venv $(VENV)-oldest
	$(VENV)-oldest/bin/pip install --quiet -r constraints-oldest.txt
	$(VENV)-oldest/bin/pip install --quiet --no-deps --no-build-isolation -e .
	@touch $@

test-oldest: $(VENV)-oldest/stamp
	$(VENV)-oldest/bin/python -m pytest -q

$(VENV)-bench/stamp: benchmarks/requirements.txt setup.py setup.cfg pyproject.toml
	$(PYTHON) -m venv $(VENV)-bench
	$(VENV)-bench/bin/pip install --quiet -r benchmarks/requirements.txt -e .
	@touch $@

$(VENV)-bench-g2o/stamp: benchmarks/requirements-g2o.txt
	$(PYTHON) -m venv $(VENV)-bench-g2o
	$(VENV)-bench-g2o/bin/pip install --quiet -r benchmarks/requirements-g2o.txt
	@touch $@

bench: $(VENV)-bench/stamp $(VENV)-bench-g2o/stamp
	$(VENV)-bench/bin/python -m benchmarks

lock:
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/pip install --quiet uv
	echo setuptools | $(COMPILE) --generate-hashes --extra jazzy setup.py - -o requirements.txt
	echo 'setuptools>=70.1' | $(COMPILE) --resolution lowest-direct setup.py - -o constraints-oldest.txt

COMPILE = $(VENV)-lock/bin/uv pip compile --quiet --universal --python-version 3.10 --extra evaluate --extra test \
  --no-emit-index-url --no-annotate --custom-compile-command 'make lock' $(LOCK)

clean:
	rm -rf $(VENV) $(VENV)-oldest $(VENV)-lock $(VENV)-bench $(VENV)-bench-g2o build install log *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
