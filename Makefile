# A fresh clone needs `make demo` or `make test`, and nothing before it.
#
# install       .venv with everything of requirements.txt, real ROS 2 included where there is none (default)
# demo          install, without the kernels of space, then the demonstration
# check         style, types and the unit tests, in a minute: after each change; no process, no ROS
# test          install, then style, types and all tests; some of them: TESTS='-m "not process"', -m integration, a file
# soak          the tests that take too long for every run: up to three hours, resumed where it was; ONLY=name,name
# site          the pages and the API as a site in site/, searchable, without a wrong link; in .venv-docs
# wheel         dist/: a wheel with compiled kernels in it, for the Python and the kind of machine that this is
# colcon        build and test as ROS does, in a scratch folder; colcon goes into .venv-colcon; TESTS=, too
# test-oldest   the tests without ROS, in .venv-oldest with the lowest versions that setup.py allows
# lint, format  check style, layers, budgets and types; correct the style
# lock          write requirements.txt and constraints-oldest.txt from setup.py; LOCK=--upgrade takes newer versions
# bench         measure ours against GTSAM and g2o into docs/figures, and the tables of the pages; hours
# robust        the same with false closures and wrong ids; two hours, each graph written when it is done
# figures       measure the table that must not get worse, docs/figures/figures.csv, and compare; half an hour; WRITE=1 replaces it
# pictures      draw the pictures of README.md and docs/ again, in Chromium
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

.PHONY: install demo check test soak site wheel colcon test-oldest lint format lock bench robust figures pictures clean
.DELETE_ON_ERROR:

install: $(VENV)/package.stamp
	@$(MAKE) --no-print-directory -j2 $(VENV)/interfaces.stamp $(VENV)/kernels.stamp

demo: $(VENV)/package.stamp
	@$(MAKE) --no-print-directory -j2 $(VENV)/interfaces.stamp $(VENV)/planar.stamp
	@$(BIN)/graph_slam demo --force

# Four on two cores, too: tests of nodes wait for half of their time.
PYTEST := $(BIN)/python -m pytest -q -n 4 --dist worksteal --durations=25 --durations-min=2 --timeout=900

check: lint $(VENV)/kernels.stamp
	$(PYTEST) -m unit

test: install lint
	$(PYTEST) $(TESTS)

soak: install
	$(BIN)/python test/soak.py $(subst $(comma), ,$(ONLY))

comma := ,

# Of what git has, in a folder of its own. For which processor kernels are compiled there, the package says.
DIST := dist
PROCESSOR = from graph_slam_ros.lie.jit import PROCESSOR; print(PROCESSOR)
ARCHIVE = import pathlib, shutil; (made,) = pathlib.Path("cache/graph_slam_ros").iterdir(); \
  shutil.make_archive(f"graph_slam_ros/{made.name}", "zip", made)
wheel: $(VENV)/package.stamp
	@set -e; scratch=$$(mktemp -d); trap 'rm -rf "$$scratch"' EXIT; python="$(abspath $(BIN))/python"; \
	git checkout-index --all --prefix="$$scratch/"; cd "$$scratch"; export PYTHONPATH="$$scratch"; \
	processor=$$("$$python" -c '$(PROCESSOR)'); \
	NUMBA_CPU_NAME=$$processor NUMBA_CPU_FEATURES= GRAPH_SLAM_CACHE=cache "$$python" -m graph_slam_ros.cli warmup; \
	"$$python" -c '$(ARCHIVE)'; \
	"$$python" -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir "$(abspath $(DIST))" .
	@ls $(DIST)

lint: $(VENV)/package.stamp
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-cache
	$(BIN)/python tools/budget.py
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

# The lines of requirements.txt that are for ROS alone are those for one kind of machine. Python compiles what it imports:
# all of it at once takes half of the installation.
without = awk '/^[^ \#]/ {keep = !/$(1)/} keep' requirements.txt > $(VENV)/requirements.txt

$(VENV)/requirements.stamp: requirements.txt $(VENV)/venv.stamp
	@echo 'graph_slam_ros: installing into $(VENV), a minute or two the first time'
ifeq ($(SYSTEM_ROS),)
	@$(PIP) install --quiet --no-compile --require-hashes -r requirements.txt || { \
	  echo 'graph_slam_ros: the ROS wheels cannot be installed, see above: going on without ROS'; \
	  $(call without,platform_machine) && $(PIP) install --quiet --no-compile --require-hashes -r $(VENV)/requirements.txt; }
else
	@$(call without,platform_machine|^numpy==|^pandas==) && \
	  $(PIP) install --quiet --no-compile --require-hashes --no-deps -r $(VENV)/requirements.txt
endif
	@touch $@

# The messages of an installed ROS are compiled for the major version of NumPy that it came with, and pandas must fit.
SAME_NUMPY = import numpy; print("numpy<%d" % (int(numpy.__version__.split(".")[0]) + 1))
$(VENV)/package.stamp: setup.py setup.cfg pyproject.toml graph_slam_ros/__init__.py $(VENV)/requirements.stamp
	@$(PIP) install --quiet --no-build-isolation \
	  $(if $(SYSTEM_ROS),-e '.[evaluate]' "$$($(PYTHON) -c '$(SAME_NUMPY)')",--no-deps -e .)
	@touch $@

# Without the stamp it is tried, and what is missing is said, every time.
$(VENV)/interfaces.stamp: tools/generate_interfaces.py $(VENV)/package.stamp
	@if $(BIN)/python tools/generate_interfaces.py; then touch $@; fi

$(VENV)/kernels.stamp $(VENV)/planar.stamp: $(SOURCES) $(VENV)/package.stamp
	@$(BIN)/graph_slam warmup --dimensions $(if $(findstring planar,$@),2,3)
	@touch $@

# The interfaces are generated with the package, which is then taken out again: what is tested is what colcon installs.
$(VENV)/colcon.stamp: $(VENV)/interfaces.stamp
	@$(PIP) install --quiet 'colcon-common-extensions==0.3.0' 'empy<4' 'setuptools<80'
	@$(PIP) uninstall --quiet --yes graph_slam_ros
	@touch $@

COLCON_VENV := $(abspath $(VENV)-colcon)
colcon:
	@$(MAKE) --no-print-directory VENV=$(COLCON_VENV) $(COLCON_VENV)/colcon.stamp
	@set -e; scratch=$$(mktemp -d); trap 'rm -rf "$$scratch"' EXIT; \
	export PATH="$(COLCON_VENV)/bin:$$PATH" $(if $(SYSTEM_ROS),,AMENT_PREFIX_PATH="$(COLCON_VENV)"); cd "$$scratch"; \
	colcon build --base-paths "$(CURDIR)"; \
	. install/local_setup.sh; \
	install/graph_slam_ros/lib/graph_slam_ros/graph_slam --version; \
	colcon test --base-paths "$(CURDIR)" --event-handlers console_direct+ --pytest-args $(TESTS); \
	colcon test-result --all

$(VENV)-oldest/stamp: constraints-oldest.txt setup.py setup.cfg pyproject.toml
	$(PYTHON) -m venv $(VENV)-oldest
	$(VENV)-oldest/bin/pip install --quiet -r constraints-oldest.txt
	$(VENV)-oldest/bin/pip install --quiet --no-deps --no-build-isolation -e .
	@touch $@

test-oldest: $(VENV)-oldest/stamp
	$(VENV)-oldest/bin/python -m pytest -q

$(VENV)-docs/stamp: docs/requirements.txt setup.py setup.cfg pyproject.toml
	$(PYTHON) -m venv $(VENV)-docs
	$(VENV)-docs/bin/pip install --quiet -r docs/requirements.txt -e .
	@touch $@

site: $(VENV)-docs/stamp
	$(VENV)-docs/bin/sphinx-build --quiet --fresh-env --fail-on-warning -d $(VENV)-docs/doctrees docs site

$(VENV)-bench/stamp: benchmarks/requirements.txt setup.py setup.cfg pyproject.toml
	$(PYTHON) -m venv $(VENV)-bench
	$(VENV)-bench/bin/pip install --quiet -r benchmarks/requirements.txt -e .
	@touch $@

$(VENV)-bench-g2o/stamp: benchmarks/requirements-g2o.txt
	$(PYTHON) -m venv $(VENV)-bench-g2o
	$(VENV)-bench-g2o/bin/pip install --quiet -r benchmarks/requirements-g2o.txt
	@touch $@

bench: $(VENV)-bench/stamp $(VENV)-bench-g2o/stamp
	for name in batch online consistency marginals; do $(VENV)-bench/bin/python -m benchmarks.$$name --write || exit; done
	$(VENV)-bench/bin/python -m benchmarks.lifelong --keyframes 6000 --seeds 1 --write

robust: $(VENV)-bench/stamp
	$(VENV)-bench/bin/python -m benchmarks.robust --jobs 2 --write

figures: $(VENV)-bench/stamp
	$(VENV)-bench/bin/python -m benchmarks.figures $(if $(WRITE),--write) $(if $(ONLY),--only '$(ONLY)')

pictures: install
	PYTHONPATH=test $(BIN)/python tools/pictures.py

lock:
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/pip install --quiet uv
	echo setuptools | $(COMPILE) --generate-hashes --extra jazzy setup.py - -o requirements.txt
	echo 'setuptools>=70.1' | $(COMPILE) --resolution lowest-direct setup.py - -o constraints-oldest.txt

COMPILE = $(VENV)-lock/bin/uv pip compile --quiet --universal --python-version 3.10 --extra evaluate --extra report --extra view --extra fleet --extra test \
  --no-emit-index-url --no-annotate --custom-compile-command 'make lock' $(LOCK)

clean:
	rm -rf $(VENV) $(VENV)-oldest $(VENV)-lock $(VENV)-docs $(VENV)-bench $(VENV)-bench-g2o build dist site install log *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
