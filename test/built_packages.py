"""Message packages that the ROS wheels lack, for tests of live nodes: built by the project's generator, and kept."""

import os
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import generate_interfaces
import pytest
from live_nodes import ENVIRONMENT


def use(package, messages, request, tmp_path_factory, monkeypatch):
    """Have it in processes of ``ENVIRONMENT``: of an installed ROS, else built once and kept.

    Without the cache of pytest it is built each time. ``messages`` are texts of definitions, by name.
    """
    if find_spec(package) is not None:
        return
    if reason := generate_interfaces.obstacle([package]):
        pytest.skip(reason)
    cache = getattr(request.config, "cache", None)
    name = "_".join([package, *messages, sysconfig.get_python_version()])
    built = Path(cache.mkdir(name)) if cache else tmp_path_factory.mktemp(name)
    if not (done := built / "built").exists():
        monkeypatch.setitem(generate_interfaces.INTERFACES, package, messages)
        generate_interfaces.generate([package], Path(sys.prefix), built)
        done.touch()
    packages = built / "lib" / f"python{sysconfig.get_python_version()}" / "site-packages"
    for name, folder in (("PYTHONPATH", packages), ("LD_LIBRARY_PATH", built / "lib")):
        monkeypatch.setitem(ENVIRONMENT, name, os.pathsep.join(filter(None, (str(folder), ENVIRONMENT.get(name)))))
