"""Nothing is let in: no code in files, no way out of the data folder, nothing that listens; and the SROS2 policy.

The package alone is held to the list of what is banned: benchmarks keep pickles of their own processes' results.
"""

import ast
import importlib.util
import re
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from places import ROOT
from yaml.constructor import BaseConstructor, SafeConstructor

import graph_slam_ros
from graph_slam_ros.config.config import parameters
from graph_slam_ros.errors import ConfigError, GraphSlamError
from graph_slam_ros.formats.durable import AppendedFile
from graph_slam_ros.formats.parameters import _StrictLoader
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
PATIENCE_S = 10.0


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


def test_X1_no_file_of_the_package_can_run_code_of_a_file():
    for name, path in FILES.items():
        assert forbidden(path.read_text()) == [], name


def test_X1_the_loader_of_parameters_makes_plain_values_alone():
    constructors = [one for one in _StrictLoader.__mro__ if issubclass(one, BaseConstructor)]
    assert constructors == [_StrictLoader, yaml.SafeLoader, SafeConstructor, BaseConstructor]


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from marshal import loads",
        "x = eval('1')",
        "import builtins\nbuiltins.exec('1')",
        "import os\nos.execv('a', [])",
        "yaml.load(text, Loader=yaml.Loader)",
        "yaml.full_load(text)",
        "yaml.load_all(text, Loader=yaml.SafeLoader)",
        "np.load(path)",
        "np.savez(path, a, allow_pickle=True)",
    ],
)
def test_X1_what_is_banned_is_found(text):
    assert forbidden(text)


def test_X3_nothing_is_given_to_a_shell():
    for text in ("import os\nos.system(x)", "subprocess.run(x, shell=True)", "subprocess.getoutput(x)", "os.popen(x)"):
        assert forbidden(text), text
    for name, path in FILES.items():
        for owner, call, words in calls(ast.parse(path.read_text())):
            assert call not in SHELL, name
            assert owner != "subprocess" or "shell" not in words, name


def test_X4_nothing_listens_but_the_middleware_and_the_view():
    """What listens has the cases X4 to X7 of its own (test_view.py): no other may come unseen."""
    for name, path in FILES.items():
        if name == "view/server.py":
            continue
        assert not LISTENING & set(modules(ast.parse(path.read_text()))), name


# -- the data folder ------------------------------------------------------------------------------------------------

OUTSIDE = ("secret", "../secret", "../../secret", "/etc", "/etc/passwd", "~", "~/secret", "run/../../secret", ".", "..")
PREFIXES = (
    "",
    "./",
    "../",
    "../../",
    "/",
    "//",
    "run/",
    "run/../",
    "\\",
    "..\\",
    "file://",
    "%2e%2e/",
    " ",
    "$(id)",
    "-",
)
BYTES = ("a\0b", "\udcff", "a\nb", "\u202e", "\uff0e\uff0e", "caf\u00e9", "x" * 101, "x" * 4096)
SIGNS = ("a b", "a;id", "a|b", "`id`", ".hidden", "*")
NAMES = sorted({p + n for p in PREFIXES for n in OUTSIDE} | {p + n for p in PREFIXES[::3] for n in BYTES + SIGNS})


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A data folder with a run, and a run outside of it that nobody may get at."""
    base = tmp_path_factory.mktemp("robot")
    write_bag(simulate("manhattan", 2, poses=12, blocks=4), base / "drive.mcap")
    for run in (base / "secret", base / "data" / "earlier"):
        run.parent.mkdir(exist_ok=True)
        replay(base / "drive.mcap", run)
    (base / "data" / "linked").symlink_to(base / "secret")
    return base / "data"


def session(folder):
    config = Config.from_mapping({"output.folder": str(folder / "now")})
    return Session(config, Counters(), lambda slam, update: None, lambda *_: None)


# T22: 200 of them
@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
def test_F27_a_name_leads_to_a_run_in_the_data_folder_or_nowhere(folders, hostile, name):
    try:
        wanted = Config.from_mapping({"output.load": name}).output.load
    except ConfigError as error:
        assert str(error).startswith("output.load: ")
        return
    assert re.fullmatch(r"[A-Za-z0-9._-]{1,100}", wanted)
    with pytest.raises(GraphSlamError, match="not a run"):
        hostile.load(wanted)


@pytest.fixture
def hostile(folders):
    s = session(folders)
    yield s
    s.finish()


def test_F27_a_link_out_of_the_data_folder_is_not_followed_and_a_run_in_it_is_loaded(hostile):
    with pytest.raises(GraphSlamError, match="linked: not a run"):
        hostile.load("linked")
    assert hostile.load("earlier").startswith("earlier: ")


def test_X2_folders_and_files_are_named_at_the_start_alone():
    """No service takes a path; a parameter that is one is read-only, but for the name of a run to load."""
    pytest.importorskip("rclpy")
    from graph_slam_ros.node.parameters import _AT_START, _descriptor

    paths = {p.name for p in parameters() if "folder" in p.name or "file" in p.name}
    assert paths == {"output.folder", "landmarks.surveyed_file"} <= _AT_START
    for p in parameters():
        assert _descriptor(p).read_only == (p.name in _AT_START)
    assert {one.type for one in SERVICES if "load" in one.name or "save" in one.name} == {"std_srvs/srv/Trigger"}


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


def test_X2_what_is_no_run_is_not_touched(folders):
    other = folders / "photographs"
    other.mkdir()
    (other / "one.jpg").write_bytes(b"one")
    with pytest.raises(GraphSlamError, match="not empty and not an earlier run; nothing was written"):
        Session(Config.from_mapping({"output.folder": str(other)}), Counters(), lambda *_: None, lambda *_: None)
    assert [file.name for file in other.iterdir()] == ["one.jpg"]


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


@pytest.fixture(scope="module")
def running():
    """A node that looks at one of ours, which runs."""
    rclpy = pytest.importorskip("rclpy")
    for package in ("vision_msgs", "tf2_msgs"):
        pytest.importorskip(package)
    from live_nodes import ENVIRONMENT, own_domain
    from rclpy.context import Context

    words = ("-p", "output.folder:=''", "-p", "use_sim_time:=true")
    command = [sys.executable, "-m", "graph_slam_ros.node.node", "--ros-args", *words]
    with own_domain() as domain:
        process = subprocess.Popen(command, env=ENVIRONMENT | {"ROS_DOMAIN_ID": domain})
        context = Context()
        context.init(args=[], domain_id=int(domain))
        node = rclpy.create_node("auditor", context=context)
        try:
            yield node
        finally:
            node.destroy_node()
            context.try_shutdown()
            process.terminate()
            process.wait(timeout=PATIENCE_S)


def until_steady(node, want):
    """(publications, subscriptions, services) of the running node, once they are as wanted or patience has ended."""
    from live_nodes import lenient

    deadline, found = time.monotonic() + lenient(PATIENCE_S), interfaces(node)  # it may still be starting
    while any(w is not None and w != f for w, f in zip(want, found, strict=True)) and time.monotonic() < deadline:
        time.sleep(0.05)
        found = interfaces(node)
    return found


def interfaces(node):
    if ("graph_slam", "/") not in node.get_node_names_and_namespaces():
        return set(), set(), set()
    ask = (
        node.get_publisher_names_and_types_by_node,
        node.get_subscriber_names_and_types_by_node,
        node.get_service_names_and_types_by_node,
    )
    return tuple({name for name, _ in names_and_types("graph_slam", "/")} for names_and_types in ask)


def test_X8_what_a_running_node_publishes_has_type_and_durability_of_the_table(running):
    until_steady(running, (allowed("topic", "publish"), None, None))
    for one in PUBLICATIONS:
        (offered,) = running.get_publishers_info_by_topic(one.resolved())
        assert offered.topic_type == one.type
        assert (offered.qos_profile.durability.name == "TRANSIENT_LOCAL") == one.latched, one.name
        assert offered.qos_profile.reliability.name == "RELIABLE"


def test_X8_the_policy_is_what_a_running_node_does(running):
    policy = (allowed("topic", "publish"), allowed("topic", "subscribe"), allowed("service", "reply"))
    if importlib.util.find_spec("rclpy.type_description_service") is None:  # Humble
        policy[2].discard("/graph_slam/get_type_description")
    for found, wanted in zip(until_steady(running, policy), policy, strict=True):
        assert sorted(found) == sorted(wanted)
