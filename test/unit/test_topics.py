"""The table of topics and services: what is written of it elsewhere says the same."""

import re
from xml.etree import ElementTree

from places import ROOT
from rows import each

from graph_slam_ros.messages.topics import PUBLICATIONS, SERVICES, SUBSCRIPTIONS

PAGE = (ROOT / "docs/ros.md").read_text()
TABLES = {"out": PUBLICATIONS, "in, and [other inputs](inputs.md)": SUBSCRIPTIONS, "service": SERVICES}


def row(one):
    latched = "latched: " if one.latched else ""
    return f"| `{one.name}` | {re.sub('/(msg|srv)/', '/', one.type)} | {latched}{one.meaning} |"


@each("head", TABLES)
def test_the_readme_has_every_row_and_no_other(head):
    _, _, below = PAGE.partition(f"| {head} | type | |\n|---|---|---|\n")
    assert below.split("\n\n")[0].splitlines() == [row(one) for one in TABLES[head]]


DEPENDENCIES = {tag.text for tag in ElementTree.parse(ROOT / "package.xml").iter("exec_depend")}


@each("table", [PUBLICATIONS, SUBSCRIPTIONS, SERVICES])
def test_each_name_is_there_once_and_each_package_is_a_dependency(table):
    assert len({one.name for one in table}) == len(table)
    assert {one.type.split("/")[0] for one in table} <= DEPENDENCIES


def test_every_message_package_that_is_imported_is_a_dependency():
    sources = "".join(path.read_text() for path in (ROOT / "graph_slam_ros").rglob("*.py"))
    imported = set(re.findall(r"^ *(?:from|import) (\w+_(?:msgs|srvs|interfaces))\b", sources, re.MULTILINE))
    assert {"rcl_interfaces"} <= imported <= DEPENDENCIES
