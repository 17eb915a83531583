"""The package as a whole: one version number, one direction of imports, requirements that fit each other."""

import ast
import re
import subprocess
import sys
from importlib.metadata import requires, version
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from places import ROOT, test_path
from planted_bugs import BUGS, Bug, Change

import graph_slam_ros
from graph_slam_ros.graph import RELATIVE_POSE, Graph
from graph_slam_ros.graph.tables import Column, EdgeTable
from graph_slam_ros.slam import GraphSlam

PACKAGE = ROOT / "graph_slam_ros"
FILES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}

# From the lowest floor up: what a folder, or a module of the top, may import of the package besides itself, errors.py
# and typing.py. Each names only what stands above its own line here, so that there is no circle.
WITHIN = {
    "errors.py": set(),
    "plugins.py": set(),
    "progress.py": set(),
    "typing.py": set(),
    "lie": set(),
    "graph": {"lie"},
    "plugin_edges.py": {"plugins", "graph"},
    "chi_square.py": set(),
    "colours.py": set(),
    "edge_tags.py": {"plugins", "plugin_edges", "graph"},
    "solver/clique_tree": {"lie", "graph"},
    "solver": {"lie", "graph", "solver/clique_tree"},
    "warmup.py": {"progress", "lie", "graph", "solver", "solver/clique_tree"},
    "formats": {"edge_tags", "lie", "graph"},
    "optimization.py": {"graph", "solver", "formats"},
    "certificate": {"lie", "graph", "solver", "optimization"},
    "measurements": {"edge_tags", "graph"},
    "config": {"lie", "graph", "solver"},
    "slam/frontend": {"chi_square", "lie", "graph", "measurements", "config"},
    "slam/landmarks": {"chi_square", "lie", "graph", "solver", "measurements", "config", "slam/frontend"},
    "slam/robust": {
        "chi_square",
        "lie",
        "graph",
        "solver",
        "measurements",
        "config",
        "slam/frontend",
        "slam/landmarks",
    },
    "slam/calibration": {"lie", "graph", "solver", "slam/frontend"},
    "slam/lifelong": {"chi_square", "lie", "graph", "solver", "solver/clique_tree", "slam/frontend"},
    "slam": {
        "chi_square",
        *("plugin_edges", "edge_tags", "lie", "graph", "solver", "measurements", "config"),
        *("slam/frontend", "slam/landmarks", "slam/robust", "slam/calibration", "slam/lifelong"),
    },
    "messages/inputs": {"plugins", "edge_tags", "lie", "graph", "formats", "measurements", "config"},
    "messages": {"colours", "lie", "graph", "formats", "measurements", "config", "slam", "messages/inputs"},
    "recordings": {"lie", "formats", "messages", "messages/inputs"},
    "check": {
        *("lie", "formats", "measurements", "config", "slam", "slam/calibration", "slam/landmarks"),
        *("messages", "messages/inputs"),
    },
    "runs": {
        *("edge_tags", "lie", "graph", "solver", "warmup", "formats", "measurements", "config"),
        *("slam", "slam/calibration", "slam/frontend", "slam/landmarks", "slam/robust", "slam/lifelong"),
        *("messages", "messages/inputs", "recordings"),
        "check",
    },
    "maps": {
        *(
            "chi_square",
            "edge_tags",
            "lie",
            "graph",
            "formats",
            "measurements",
            "slam",
            "slam/calibration",
            "slam/landmarks",
            "slam/lifelong",
            "slam/robust",
        ),
        *("messages", "recordings", "runs"),
    },
    "analysis": {
        "colours",
        *(
            "chi_square",
            "edge_tags",
            "lie",
            "graph",
            "solver",
            "formats",
            "measurements",
            "slam",
            "slam/landmarks",
            "slam/robust",
        ),
        *("messages/inputs", "recordings", "runs", "maps"),
    },
    "report": {
        "colours",
        *("chi_square", "graph", "lie", "formats", "measurements", "config", "slam", "slam/landmarks", "slam/robust"),
        *("recordings", "runs", "maps", "analysis"),
    },
    "view": {"graph", "solver", "measurements", "slam", "slam/robust", "runs", "maps", "analysis", "report"},
    "simulation": {
        "chi_square",
        "edge_tags",
        "lie",
        "graph",
        "formats",
        "slam",
        "messages",
        "messages/inputs",
        "recordings",
    },
    "fleet": {"graph", "solver", "formats", "config", "slam", "runs", "analysis", "report", "simulation"},
    "node": {
        *("graph", "warmup", "formats", "measurements", "config", "slam", "slam/frontend", "slam/robust"),
        *("slam/calibration", "messages", "messages/inputs", "recordings", "check", "runs"),
    },
    "cli": {
        *("progress", "warmup", "graph", "solver", "optimization", "certificate", "formats", "config"),
        *("slam", "messages/inputs", "recordings", "check", "runs", "maps", "analysis", "report", "simulation", "node"),
        *("measurements", "view", "fleet"),
    },
    "__init__.py": {
        *(
            "graph",
            "solver",
            "optimization",
            "certificate",
            "formats",
            "measurements",
            "config",
            "slam",
            "runs",
            "maps",
        ),
    },
}
# What is not the standard library's and not ours.
THIRD_PARTY = {
    "errors.py": set(),
    "typing.py": {"numpy"},
    "chi_square.py": {"scipy"},
    "colours.py": set(),
    "lie": {"numpy", "numba"},
    "lie/jit.py": {"numpy", "numba", "llvmlite"},  # the compiler, and its version
    "graph": {"numpy", "numba"},
    "solver": {"numpy", "numba", "scipy"},
    "measurements": {"numpy"},
    "config": set(),
    "slam": {"numpy", "scipy"},
    "formats": {"numpy", "yaml"},
    "certificate": {"numpy", "scipy"},
    "messages": {"numpy", "scipy", "rosbags"},
    "recordings": {"rosbags", "mcap", "lz4", "zstandard"},  # the last two are mcap's own
}
SERVES = {"view/guard.py", "view/server.py"}  # with the extra `view`, which may not be there
DISTRIBUTES = {  # with the extra `fleet`
    *(f"fleet/{name}.py" for name in ("recordings", "job", "table", "engine", "replay", "compare", "simulate")),
    *(f"fleet/{name}.py" for name in ("search", "fit", "tune", "tuned")),
}
NOT_BELOW_MESSAGES = {"random", "secrets", "threading", "time", "uuid"}
NEVER = {
    "graph": NOT_BELOW_MESSAGES | {"logging", "os", "pathlib"},
    "solver": NOT_BELOW_MESSAGES,
    "measurements": NOT_BELOW_MESSAGES | {"datetime", "os", "pathlib"},
    "config": NOT_BELOW_MESSAGES | {"datetime", "os", "pathlib"},
    "slam": NOT_BELOW_MESSAGES | {"datetime", "os", "pathlib"},
    "certificate": NOT_BELOW_MESSAGES | {"matplotlib"},
    "messages": {"matplotlib"},
    "recordings": {"matplotlib"},
    "check": NOT_BELOW_MESSAGES | {"datetime", "os", "pathlib", "matplotlib"},
    "runs": {"matplotlib"},
    "simulation": {"matplotlib"},
    "node": {"matplotlib"},
    "node/node.py": {"numpy", "scipy"},
    "analysis/evaluation.py": {"matplotlib"},
}
SPEAK_RCLPY = {
    f"node/{name}.py"
    for name in ("bond", "node", "player", "qos", "ingest", "subscriptions", "publishers", "parameters", "static_rival")
}
SPEAK_MESSAGES = SPEAK_RCLPY | {
    "messages/to_msg.py",
    *(f"node/{name}.py" for name in ("tf_broadcaster", "services", "runtime", "fact_collector", "publishing_clock")),
}
OUTSIDE_THE_SOLVER = {"cli", "analysis/plots.py"}


def imported(name):
    """All modules that a file imports, wherever in it, by their full names."""
    folder = ["graph_slam_ros", *name.split("/")[:-1]]
    for node in ast.walk(ast.parse(FILES[name].read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = folder[: len(folder) - node.level + 1] if node.level else []
            module = ".".join([*parents, *filter(None, [node.module])])
            if module == "graph_slam_ros":
                yield from (f"{module}.{alias.name}" for alias in node.names)
            else:
                yield module


def rule(table, name):
    """The rule for a file, else for the nearest of its folders that has one, else None."""
    return next((table[str(at)] for at in (Path(name), *Path(name).parents) if str(at) in table), None)


COLUMNS = {
    name
    for of in (Graph(), EdgeTable(RELATIVE_POSE, 0))
    for name in dir(of)
    if not name.startswith("__") and isinstance(getattr(of, name), Column)
}
BULK = {  # the stored numbers of many vertices, or the noise of many edges, at once
    *("slam/frontend/noise_factors.py", "slam/noise_scale.py"),
    *("slam/calibrator.py", "slam/calibration/fit.py"),
    *("slam/calibration/model.py", "slam/calibration/rows.py"),
    *("slam/backend.py", "slam/robust/pairwise_consistency.py", "slam/robust/landmark_support.py"),
    *("runs/map_growth.py", "runs/ledger_file.py", "analysis/what_if.py", "simulation/pose_graph.py"),
    *("fleet/held_out.py", "check/trial.py", "slam/condensed_edges.py", "slam/lifelong/surroundings.py"),
    *("slam/robust/mirrored.py", "slam/robust/innovation.py", "slam/robust/tightness.py"),
}


def indexed_columns(tree):
    """Lines where a column of the graph's tables is indexed, or a row of them is asked for."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Attribute) and node.value.attr == "values":
            column = node.value.value
            if isinstance(column, ast.Attribute) and column.attr in COLUMNS:
                yield node.lineno
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "row":
            yield node.lineno


def test_indexed_columns_are_found():
    text = "t, k = graph.row(e)\nx = t.weight.values[k]\ny = graph.offset.values[[1, 2]]\nz = ledger.numbers.values[e]"
    assert {"measured", "offset", "row_of_edge", "weight"} <= COLUMNS
    assert list(indexed_columns(ast.parse(text))) == [1, 2, 3]


def test_nobody_outside_graph_and_solver_indexes_their_tables():
    found = {name for name, path in FILES.items() if list(indexed_columns(ast.parse(path.read_text())))}
    outside = {name for name in found if not name.startswith(("graph/", "solver/"))}
    assert outside == BULK, "use Graph.edge(id), Graph.vertex(id) or EdgeTable.at(rows)"


def test_the_version_number_is_the_same_everywhere():
    assert ElementTree.parse(ROOT / "package.xml").findtext("version") == graph_slam_ros.__version__
    assert version("graph_slam_ros") == graph_slam_ros.__version__


@pytest.mark.parametrize("path", sorted((ROOT / "config").glob("*.yaml")), ids=lambda path: path.name)
def test_every_shipped_yaml_is_a_mapping(path):
    assert isinstance(yaml.safe_load(path.read_text()), dict)


def home(module):
    """The folder, or module of the top, that a full name belongs to."""
    path = module.removeprefix("graph_slam_ros.").replace(".", "/")
    file = f"{path}.py" if f"{path}.py" in FILES else f"{path}/__init__.py"
    if file not in FILES:  # a name of the package itself
        return "__init__"
    folder = str(Path(file).parent)
    return folder if folder != "." else Path(file).stem


@pytest.mark.parametrize("name", FILES)
def test_imports_within_the_package_go_one_way(name):
    ours = [module for module in imported(name) if module.startswith("graph_slam_ros.")]
    folder = str(Path(name).parent)
    own = name if folder == "." else folder
    assert {home(module) for module in ours} - {own, "__init__", "errors", "typing"} <= WITHIN[own]
    if rule(dict.fromkeys(OUTSIDE_THE_SOLVER, True), name):
        assert not [module for module in ours if module.startswith("graph_slam_ros.solver.")]


def test_the_floors_of_the_package_have_no_circle():
    folders = {str(Path(name).parent) if "/" in name else name for name in FILES}
    assert set(WITHIN) == folders
    below = set()
    for own, allowed in WITHIN.items():
        assert allowed <= below, own
        below.add(own.removesuffix(".py"))


@pytest.mark.parametrize("name", FILES)
def test_a_folder_imports_only_the_libraries_it_is_built_on(name):
    tops = {module.split(".")[0] for module in imported(name)} - {"graph_slam_ros"}
    allowed = rule(THIRD_PARTY, name)
    if allowed is not None:
        assert tops - sys.stdlib_module_names <= allowed
    assert not tops & ((NEVER.get(name) or set()) | (NEVER.get(name.split("/")[0]) or set()))
    assert "evo" not in tops  # GPL-3.0, and for tests alone
    assert not [m for m in imported(name) if m.startswith("scipy.stats")], "half a second: scipy.special has the same"
    if name not in SPEAK_RCLPY:
        assert "rclpy" not in tops
    if name not in SPEAK_MESSAGES:
        assert not [top for top in tops if re.fullmatch(r"\w+_(msgs|srvs|interfaces)", top)]


MOST_LINES, MOST_OF_A_FUNCTION, MOST_ATTRIBUTES = 400, 60, 15


@pytest.mark.parametrize("name", FILES)
def test_modules_and_functions_are_short(name):
    text = FILES[name].read_text()
    assert len(text.splitlines()) <= MOST_LINES
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno - node.lineno + 1 <= MOST_OF_A_FUNCTION, node.name


def test_the_pipeline_has_few_attributes_and_one_short_class():
    assert len(vars(GraphSlam())) <= MOST_ATTRIBUTES
    assert len(FILES["slam/graph_slam.py"].read_text().splitlines()) <= 300


@pytest.mark.parametrize("name", FILES)
def test_only_the_command_lines_console_prints(name):
    calls = [node.func for node in ast.walk(ast.parse(FILES[name].read_text())) if isinstance(node, ast.Call)]
    assert name == "cli/console.py" or not [call for call in calls if isinstance(call, ast.Name) and call.id == "print"]


def test_everything_but_the_node_imports_without_ros():
    modules = [
        ".".join(["graph_slam_ros", *Path(name).with_suffix("").parts]).removesuffix(".__init__")
        for name in FILES
        if name not in SPEAK_MESSAGES
        and (name not in SERVES or find_spec("uvicorn"))
        and (name not in DISTRIBUTES or all(map(find_spec, ("distributed", "duckdb", "fsspec", "optuna"))))
    ]
    script = f"""
import importlib, sys
class NoRos:
    def find_spec(self, name, path=None, target=None):
        if name == "rclpy" or name.endswith(("_msgs", "_srvs")):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, NoRos())
for module in {modules}:
    importlib.import_module(module)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_package_itself_imports_nothing():
    script = "import sys; before = set(sys.modules); import graph_slam_ros; print(*(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == ["graph_slam_ros"]


def pins(file):
    """Normalised names to the versions that a lock names for them, one for each kind of machine."""
    found = re.findall(r"^([\w.-]+)==([^\s;]+)", (ROOT / file).read_text(), re.MULTILINE)
    return {name: {v for n, v in found if n == name} for name, _ in found}


@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)
def test_each_planted_bug_changes_something_that_is_there(bug):
    before, after = bug.planted(ROOT)
    assert all(after[file] != text for file, text in before.items())
    assert all(compile(text, file, "exec") for file, text in after.items())
    for test in bug.tests:
        file, name = test.partition("[")[0].split("::")
        assert f"def {name}(" in (ROOT / test_path(file)).read_text()


@pytest.mark.parametrize("symbol", ["missing", "There.missing", "twice", "There.wrapped"])
def test_a_bug_is_not_planted_where_its_symbol_is_not(symbol, tmp_path):
    source = "class There:\n    @property\n    def wrapped(self): ...\ndef twice(): ...\ndef twice(): ...\n"
    (tmp_path / "graph_slam_ros").mkdir()
    (tmp_path / "graph_slam_ros" / "a.py").write_text(source)
    with pytest.raises(LookupError, match=rf"^one: a\.py\b.* {re.escape(symbol)}\b"):
        Bug("one", "", (Change("a.py", symbol, "return"),), ()).planted(tmp_path)
    with pytest.raises(LookupError, match=r"^one: there is no b\.py"):
        Bug("one", "", (Change("b.py", symbol, "return"),), ()).planted(tmp_path)


def test_a_bug_is_what_its_symbol_is_instead(tmp_path):
    source = "A, B = 1, 2\nclass There:\n    c: int = (\n        3)  # \u00e4\n"
    source += "    def f(self, x: 'int' = 1):\n        return x\n"
    for change in (
        Change("", "A, B", "4, 5"),
        Change("", "There.c", "6"),
        Change("", "There.f", "if x:\n    return 10 * original(self, x)"),
    ):
        source = change.made(source)
    names = {}
    exec(compile(source, "planted", "exec"), names)
    there = names["There"]
    assert (names["A"], names["B"], there.c, there().f(), there().f(7)) == (4, 5, 6, 10, 70)


def test_both_locks_fit_the_requirements():
    latest, oldest = pins("requirements.txt"), pins("constraints-oldest.txt")
    lines = [line for line in requires("graph_slam_ros") if "extra" not in line]
    assert len(lines) > 5
    for line in lines:
        name, bound = re.fullmatch(r"([\w.-]+) ?>=([\d.]+)", line).groups()
        name = re.sub(r"[-_.]+", "-", name).lower()
        assert name in latest
        (lowest,) = oldest[name]
        assert [int(part) for part in lowest.split(".")] == [int(part) for part in bound.split(".")]


def test_the_lock_names_no_server_and_has_a_hash_for_every_distribution():
    text = (ROOT / "requirements.txt").read_text()
    assert "://" not in text
    assert "--index" not in text
    blocks = re.split(r"\n(?=\w)", text)
    assert [block for block in blocks[1:] if "--hash=sha256:" not in block] == []
