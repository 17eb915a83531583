"""The package as a whole: one version number, one direction of imports, requirements that fit each other."""

import re
import subprocess
import sys
from importlib.metadata import requires, version
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

from places import ROOT, test_path
from planted_bugs import BUGS
from rows import each

import graph_slam_ros

PACKAGE = ROOT / "graph_slam_ros"
FILES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}

SERVES = {"tools/view/server.py"}  # with the extra `view`, which may not be there
DISTRIBUTES = {  # with the extra `fleet`
    f"tools/fleet/{name}.py" for name in ("recordings", "job", "replay", "compare", "store", "page")
}
SPEAK_RCLPY = {
    f"node/{name}.py"
    for name in ("bond", "node", "player", "qos", "ingest", "subscriptions", "publishers", "parameters")
}
SPEAK_MESSAGES = SPEAK_RCLPY | {
    "messages/to_msg.py",
    *(f"node/{name}.py" for name in ("tf_broadcaster", "services", "runtime", "fact_collector")),
}


def test_the_version_number_is_the_same_everywhere():
    assert ElementTree.parse(ROOT / "package.xml").findtext("version") == graph_slam_ros.__version__
    assert version("graph_slam_ros") == graph_slam_ros.__version__
    for file in ("recipe/recipe.yaml", "CITATION.cff"):
        assert re.findall(r"(?m)^ *version: ([\d.]+)", (ROOT / file).read_text()) == [graph_slam_ros.__version__]


def test_everything_but_the_node_imports_without_ros():
    modules = [
        ".".join(["graph_slam_ros", *Path(name).with_suffix("").parts]).removesuffix(".__init__")
        for name in FILES
        if name not in SPEAK_MESSAGES
        and (name not in SERVES or find_spec("uvicorn"))
        and (name not in DISTRIBUTES or all(map(find_spec, ("distributed", "fsspec", "pyarrow"))))
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


@each("bug", BUGS)
def test_each_planted_bug_changes_something_that_is_there(bug):
    before, after = bug.planted(ROOT)
    assert all(after[file] != text for file, text in before.items())
    assert all(compile(text, file, "exec") for file, text in after.items())
    for test in bug.tests:
        file, name = test.partition("[")[0].split("::")
        assert f"def {name}(" in (ROOT / test_path(file)).read_text()


def test_both_locks_and_the_recipe_fit_the_requirements():
    latest, oldest = pins("requirements.txt"), pins("constraints-oldest.txt")
    lines = [line for line in requires("graph_slam_ros") if "extra" not in line]
    assert len(lines) > 5
    for line in lines:
        name, bound = re.fullmatch(r"([\w.-]+) ?>=([\d.]+)", line).groups()
        name = re.sub(r"[-_.]+", "-", name).lower()
        assert name in latest
        assert re.search(rf"- {name}(-base)? >={bound}\n", (ROOT / "recipe/recipe.yaml").read_text())
        (lowest,) = oldest[name]
        assert [int(part) for part in lowest.split(".")] == [int(part) for part in bound.split(".")]


def test_the_lock_names_no_server_and_has_a_hash_for_every_distribution():
    text = (ROOT / "requirements.txt").read_text()
    assert "://" not in text
    assert "--index" not in text
    blocks = re.split(r"\n(?=\w)", text)
    assert [block for block in blocks[1:] if "--hash=sha256:" not in block] == []
