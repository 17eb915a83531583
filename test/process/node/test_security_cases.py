"""Nothing is let in: no code in files, no way out of the data folder, nothing that listens; and the SROS2 policy."""

import ast
import contextlib
import importlib.util
import re
import shutil
import subprocess
import sys
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
OWN_SERVICES = (
    "change_state get_state get_available_states get_available_transitions get_transition_graph describe_parameters"
    " get_parameter_types get_parameters list_parameters set_parameters set_parameters_atomically get_type_description"
)
OWN_SERVICES = {f"/graph_slam/{name}" for name in OWN_SERVICES.split()}

# Of ruff's rules: what runs code that a file, a message or a name brings along, or gives it to a shell.
UNSAFE = "S102,S301,S302,S307,S506,S602,S604,S605,S606"
BANNED = """import builtins, os, subprocess, marshal, yaml
eval('1')
builtins.exec('1')
marshal.loads(b'')
os.execv('a', [])
os.popen(x)
subprocess.run(x, shell=True)
yaml.load(text, Loader=yaml.Loader)
"""
READERS = re.compile(
    r"allow_pickle|\bnp\.(load|fromregex)\(|__import__|^ *(import|from) (pickle|shelve|dill|joblib|runpy|code)\b", re.M
)
LISTENING = "socket|socketserver|http|xmlrpc|asyncio|websockets|aiohttp|flask|tornado"


def unsafe(path):
    """The lines with such calls."""
    words = [sys.executable, "-m", "ruff", "check", "--isolated", "--output-format=concise", "--select", UNSAFE, path]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    found = re.findall(r"^(.*?):(\d+):\d+: S\d+", done.stdout, re.MULTILINE)
    assert bool(done.returncode) == bool(found), done.stderr
    return [Path(file).read_text().splitlines()[int(line) - 1] for file, line in found]


def test_X1_X3_no_file_of_the_package_can_run_code_of_a_file_or_give_anything_to_a_shell(tmp_path):
    (tmp_path / "bad.py").write_text(BANNED)
    assert unsafe(tmp_path) == BANNED.splitlines()[1:]
    assert all("Loader=_StrictLoader" in line for line in unsafe(PACKAGE))
    assert [name for name, path in FILES.items() if READERS.search(path.read_text())] == []


def test_X4_nothing_listens_but_the_middleware_and_the_view():
    """The view has the cases X4 to X7 (test_view.py). The player holds a port of the loopback and reads nothing."""
    found = [name for name, at in FILES.items() if re.search(rf"(?m)^ *(import|from) ({LISTENING})\b", at.read_text())]
    assert found == ["node/player.py", "tools/view/server.py"]


OUTSIDE = ("secret", "../secret", "../../secret", "/etc", "/etc/passwd", "~", "~/secret", "run/../../secret", ".", "..")
SLASHED = "./ ../ ../../ / // run/ run/../ \\ ..\\ file:// %2e%2e/ $(id) -"
PREFIXES = ["", *SLASHED.split(" "), " "]
BYTES = ("a\0b", "\udcff", "a\nb", "\u202e", "\uff0e\uff0e", "caf\u00e9", "x" * 101, "x" * 4096)
SIGNS = "a b", "a;id", "a|b", "`id`", ".hidden", "*"
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
                if isinstance(node, ast.Call) and ast.unparse(node.func).endswith((".get_logger().info", "log.info")):
                    told.append(ast.unparse(node.args[0]))
    assert sorted(told) == [
        "'bond with the lifecycle manager'",
        "'compiling kernels, once per installation: about a minute'",
        "f'kernels ready after {elapsed_s:.1f} s'",
        "f'saved {Path(folder).name}'",
        "message",
        "str(error)",
        "verdict.text",
    ]


def allowed(kind, how):
    """Fully qualified names of a kind (topic, service) that may be used so."""
    lists = [one for one in PROFILE.findall(f"{kind}s") if one.get(how)]
    assert [one.attrib for one in lists] == [{how: "ALLOW"}]
    names = [Interface(name.text, "", "").resolved() for name in lists[0].findall(kind)]
    assert len(set(names)) == len(names)
    return set(names)


def test_X8_the_policy_is_of_this_node_and_allows_what_the_table_of_topics_says():
    assert (POLICY.tag, POLICY.get("version")) == ("policy", "0.2.0")
    (enclave,) = POLICY.findall("enclaves/enclave")
    (profile,) = enclave.findall("profiles/profile")
    assert (enclave.get("path"), profile.attrib) == ("/graph_slam", {"ns": "/", "node": "graph_slam"})
    assert allowed("topic", "publish") == {one.resolved() for one in PUBLICATIONS} | OWN_PUBLICATIONS
    assert allowed("topic", "subscribe") == {one.resolved() for one in SUBSCRIPTIONS}
    assert allowed("service", "reply") == {one.resolved() for one in SERVICES} | OWN_SERVICES


def test_X2_X8_a_running_node_does_what_policy_and_table_say_and_its_folders_and_files_are_read_only():
    live = pytest.importorskip("live_nodes")
    from rcl_interfaces.srv import DescribeParameters

    policy = (allowed("topic", "publish"), allowed("topic", "subscribe"), allowed("service", "reply"))
    if importlib.util.find_spec("rclpy.type_description_service") is None:  # Humble
        policy[2].discard("/graph_slam/get_type_description")
    with live.node("output.folder:=''", "use_sim_time:=true"), live.robot(hears=(), sends=()) as r:

        def interfaces():
            if ("graph_slam", "/") not in r.node.get_node_names_and_namespaces():
                return set(), set(), set()
            ask = (
                getattr(r.node, f"get_{what}_names_and_types_by_node")
                for what in ("publisher", "subscriber", "service")
            )
            return tuple({name for name, _ in names_and_types("graph_slam", "/")} for names_and_types in ask)

        with contextlib.suppress(AssertionError):
            live.until(lambda: interfaces() == policy, r.spin, "what the policy allows", 30.0)
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
