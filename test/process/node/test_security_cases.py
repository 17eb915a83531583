"""Nothing is let in: no code in files, no way out of the data folder, nothing that listens; and the SROS2 policy.

The package alone is held to the list of what is banned: benchmarks keep pickles of their own processes' results.
"""

import ast
import contextlib
import importlib.util
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest
from places import ROOT

import graph_slam_ros
from graph_slam_ros.config.config import parameters
from graph_slam_ros.errors import ConfigError, GraphSlamError
from graph_slam_ros.formats.durable import AppendedFile
from graph_slam_ros.messages.topics import PUBLICATIONS, SERVICES, SUBSCRIPTIONS, Interface
from graph_slam_ros.node.session import Session
from graph_slam_ros.runs.folder import changed_since
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config, Counters, Odometry
from graph_slam_ros.tools.simulation import simulate, write_bag

PACKAGE = Path(graph_slam_ros.__file__).parent
FILES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}
POLICY = ElementTree.parse(ROOT / "config" / "sros2_policy.xml").getroot()
PROFILE = POLICY.find("enclaves/enclave/profiles/profile")
# of rclpy's lifecycle node
OWN_PUBLICATIONS = {"/graph_slam/transition_event", "/parameter_events", "/rosout"}
LIFECYCLE = ("change_state", "get_state", "get_available_states", "get_available_transitions", "get_transition_graph")
PARAMETERS = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)
OWN_SERVICES = {f"/graph_slam/{name}" for name in (*LIFECYCLE, *PARAMETERS, "get_type_description")}


# -- what the package may not do ------------------------------------------------------------------------------------

CODE = {"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "code", "codeop", "runpy", "pty"}
LISTENING = {"socket", "socketserver", "http", "xmlrpc", "asyncio", "websockets", "aiohttp", "flask", "tornado"}
BUILTIN = {"eval", "exec", "compile", "__import__", "breakpoint"}
SHELL = {"system", "popen", "getoutput", "getstatusoutput"}


def calls(tree):
    """Each call with its function's name and what that is an attribute of."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            owner, _, name = ast.unparse(node.func).rpartition(".")
            yield owner, name, {word.arg: ast.unparse(word.value) for word in node.keywords}


def modules(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.split(".")[0]


def forbidden(text):
    """What of a source could run code that a file, a message or a name brings along."""
    tree = ast.parse(text)
    found = sorted(CODE & set(modules(tree)))
    for owner, name, words in calls(tree):
        whole = f"{owner}.{name}" if owner else name
        if (not owner or owner == "builtins") and name in BUILTIN:
            found.append(whole)
        if name in SHELL or (name.startswith(("exec", "spawn")) and owner == "os") or "shell" in words:
            found.append(f"{whole}: a shell")
        if owner == "yaml" and name.endswith("load") and words.get("Loader") != "_StrictLoader" and name != "safe_load":
            found.append(whole)
        if owner == "yaml" and name.endswith("load_all"):
            found.append(whole)
        if "allow_pickle" in words or (owner in ("np", "numpy") and name in ("load", "fromregex")):
            found.append(whole)
    return found


def test_X1_X3_no_file_of_the_package_can_run_code_of_a_file_or_give_anything_to_a_shell():
    for name, path in FILES.items():
        assert forbidden(path.read_text()) == [], name


BANNED = """import pickle
from marshal import loads
x = eval('1')
import builtins; builtins.exec('1')
import os; os.execv('a', [])
import os; os.system(x)
os.popen(x)
subprocess.run(x, shell=True)
subprocess.getoutput(x)
yaml.load(text, Loader=yaml.Loader)
yaml.full_load(text)
yaml.load_all(text, Loader=yaml.SafeLoader)
np.load(path)
np.savez(path, a, allow_pickle=True)"""


def test_X1_X3_what_is_banned_is_found():
    for text in BANNED.splitlines():
        assert forbidden(text), text


def test_X4_nothing_listens_but_the_middleware_and_the_view():
    """What listens has the cases X4 to X7 of its own (test_view.py): no other may come unseen."""
    for name, path in FILES.items():
        if name == "tools/view/server.py":
            continue
        assert not LISTENING & set(modules(ast.parse(path.read_text()))), name


# -- the data folder ------------------------------------------------------------------------------------------------

OUTSIDE = ("secret", "../secret", "../../secret", "/etc", "/etc/passwd", "~", "~/secret", "run/../../secret", ".", "..")
SLASHED = "./ ../ ../../ / // run/ run/../ \\ ..\\ file:// %2e%2e/ $(id) -"
PREFIXES = ["", *SLASHED.split(" "), " "]
BYTES = ("a\0b", "\udcff", "a\nb", "\u202e", "\uff0e\uff0e", "caf\u00e9", "x" * 101, "x" * 4096)
SIGNS = ("a b", "a;id", "a|b", "`id`", ".hidden", "*")
NAMES = sorted({p + n for p in PREFIXES for n in OUTSIDE} | {p + n for p in PREFIXES[::3] for n in BYTES + SIGNS})


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A data folder with a run, and a run outside of it that nobody may get at."""
    base = tmp_path_factory.mktemp("robot")
    write_bag(simulate("manhattan", 2, poses=12, blocks=4), base / "drive.mcap")
    replay(base / "drive.mcap", base / "secret")
    shutil.copytree(base / "secret", base / "data" / "earlier")
    (base / "data" / "linked").symlink_to(base / "secret")
    return base / "data"


def session(folder):
    config = Config.from_mapping({"output.folder": str(folder / "now")})
    return Session(config, Counters(), lambda slam, update: None, lambda *_: None)


def test_F27_a_name_leads_to_a_run_in_the_data_folder_or_nowhere(folders):
    running = session(folders)
    for name in NAMES:  # T22: 200 of them
        try:
            wanted = Config.from_mapping({"output.load": name}).output.load
        except ConfigError as error:
            assert str(error).startswith("output.load: ")
            continue
        assert re.fullmatch(r"[A-Za-z0-9._-]{1,100}", wanted)
        with pytest.raises(GraphSlamError, match="not a run"):
            running.load(wanted)
    with pytest.raises(GraphSlamError, match="linked: not a run"):
        running.load("linked")  # a link out of the data folder
    assert running.load("earlier").startswith("earlier: ")
    running.finish()


def test_X2_an_earlier_run_is_not_written_over(folders):
    before = {file.name: file.read_bytes() for file in (folders / "earlier").iterdir()}
    config = Config.from_mapping({"output.folder": str(folders / "earlier")})
    Session(config, Counters(), lambda slam, update: None, lambda *_: None).finish()
    assert {file.name: file.read_bytes() for file in (folders / "earlier-1").iterdir()} == before


def test_F27_a_link_in_the_run_folder_is_not_written_through(folders):
    victim = folders / "victim"
    victim.write_text("mine")
    running = session(folders)
    for name in ("graph.g2o", "run.json", "path.tum", "config.yaml"):
        for link in (folders / "now" / name, folders / "now" / f"{name}.new"):
            link.unlink(missing_ok=True)
            link.symlink_to(victim)
    running.ingest([Odometry(10**18 + k * 10**8, (0.3 * k, 0.0, 0.0), None) for k in range(20)])
    running.save()
    assert victim.read_text() == "mine"
    assert not (folders / "now" / "path.tum").is_symlink()
    config = folders / "now" / "config.yaml"
    assert changed_since(config.parent) == ["config.yaml cannot be read: a symbolic link, which is not followed here"]
    config.unlink()
    config.write_text("")
    assert changed_since(config.parent) == ["config.yaml is not the one that run.json was saved with"]
    (folders / "now" / "run_9.mcap").symlink_to(victim)
    file = AppendedFile(folders / "now" / "run_9.mcap")
    file.write(b"theirs")
    with pytest.raises(OSError, match="File exists"):
        file.flush()
    assert victim.read_text() == "mine"


def test_X10_what_the_node_tells_has_neither_paths_nor_positions():
    """Whatever is logged at INFO is in this list: a folder by its name alone, no position, no fix."""
    told = []
    for name, path in FILES.items():
        if name.startswith("node/"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and ast.unparse(node.func).endswith((".get_logger().info", "._log.info")):
                    told.append(ast.unparse(node.args[0]))
    assert sorted(told) == [
        "'bond with the lifecycle manager'",
        "'compiling kernels, once per installation: about a minute'",
        "f'kernels ready after {elapsed_s:.1f} s'",
        "f'saved {Path(folder).name}'",
        "f'{run.name} was stopped while measurements waited: its results are being completed'",
        "f'{self._run.name}: its results are complete'",
        "line",
        "message",
        "str(error)",
    ]


# -- the SROS2 policy -----------------------------------------------------------------------------------------------


def allowed(kind, how):
    """Fully qualified names of a kind (topic, service) that may be used so."""
    lists = [one for one in PROFILE.findall(f"{kind}s") if one.get(how)]
    assert [one.attrib for one in lists] == [{how: "ALLOW"}]
    names = [Interface(name.text, "", "").resolved() for name in lists[0].findall(kind)]
    assert len(set(names)) == len(names)
    return set(names)


def test_X8_the_policy_is_of_the_version_that_sros2_reads_and_of_this_node():
    assert (POLICY.tag, POLICY.get("version")) == ("policy", "0.2.0")
    (enclave,) = POLICY.findall("enclaves/enclave")
    (profile,) = enclave.findall("profiles/profile")
    assert (enclave.get("path"), profile.attrib) == ("/graph_slam", {"ns": "/", "node": "graph_slam"})


def test_X8_the_policy_allows_what_the_table_of_topics_says():
    assert allowed("topic", "publish") == {one.resolved() for one in PUBLICATIONS} | OWN_PUBLICATIONS
    assert allowed("topic", "subscribe") == {one.resolved() for one in SUBSCRIPTIONS}
    assert allowed("service", "reply") == {one.resolved() for one in SERVICES} | OWN_SERVICES


@pytest.fixture
def running():
    """A robot that looks at a node of ours, which runs: for the node, and its publications, subscriptions, services."""
    live_nodes = pytest.importorskip("live_nodes")
    with live_nodes.node("output.folder:=''", "use_sim_time:=true"), live_nodes.robot(hears=(), sends=()) as r:

        def interfaces():
            if ("graph_slam", "/") not in r.node.get_node_names_and_namespaces():
                return set(), set(), set()
            ask = (
                r.node.get_publisher_names_and_types_by_node,
                r.node.get_subscriber_names_and_types_by_node,
                r.node.get_service_names_and_types_by_node,
            )
            return tuple({name for name, _ in names_and_types("graph_slam", "/")} for names_and_types in ask)

        yield r, interfaces, live_nodes.until


def test_X2_X8_a_running_node_does_what_policy_and_table_say_and_its_folders_and_files_are_read_only(running):
    from rcl_interfaces.srv import DescribeParameters

    r, interfaces, until = running
    policy = (allowed("topic", "publish"), allowed("topic", "subscribe"), allowed("service", "reply"))
    if importlib.util.find_spec("rclpy.type_description_service") is None:  # Humble
        policy[2].discard("/graph_slam/get_type_description")
    with contextlib.suppress(AssertionError):
        until(lambda: interfaces() == policy, r.spin, "what the policy allows", 30.0)
    for found, wanted in zip(interfaces(), policy, strict=True):
        assert sorted(found) == sorted(wanted)
    for one in PUBLICATIONS:
        (offered,) = r.node.get_publishers_info_by_topic(one.resolved())
        assert offered.topic_type == one.type
        assert (offered.qos_profile.durability.name == "TRANSIENT_LOCAL") == one.latched, one.name
        assert offered.qos_profile.reliability.name == "RELIABLE"
    paths = [p.name for p in parameters() if "folder" in p.name or "file" in p.name]
    assert sorted(paths) == ["landmarks.surveyed_file", "output.folder"]
    request = DescribeParameters.Request(names=[*paths, "output.load", "solve.method"])
    told = r.call("describe_parameters", DescribeParameters, request).descriptors
    assert [one.read_only for one in told] == [True, True, False, False]
    assert {one.type for one in SERVICES if "load" in one.name or "save" in one.name} == {"std_srvs/srv/Trigger"}
