"""A package of one module, installed as pip does: the file, and a .dist-info folder with its entry points."""

import sys
from contextlib import contextmanager
from importlib import invalidate_caches


@contextmanager
def installer(folder, monkeypatch):
    """A function that installs a module ``my_...`` until the end; its distribution is of the same name, version 1.0."""

    def install(text, *, group, name, module, at, more=""):
        site = folder / f"site_{module}"
        info = site / f"{module}-1.0.dist-info"
        info.mkdir(parents=True)
        (site / f"{module}.py").write_text(text)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module.replace('_', '-')}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}:{at}\n{more}")
        monkeypatch.syspath_prepend(str(site))
        invalidate_caches()
        return site

    yield install
    for module in [name for name in sys.modules if name.startswith("my_")]:
        del sys.modules[module]
