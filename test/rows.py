"""A table as one test: every row is tried, and what fails is named by its row."""

import functools
import inspect

import pytest


def each(names, rows):
    """Decorate a test, as ``pytest.mark.parametrize`` does, but for one case: of rows that cost next to nothing.

    Each row has a folder ``tmp_path`` of its own, and ``capsys`` begins anew; other fixtures are shared.
    """
    names, rows = names.replace(" ", "").split(","), list(rows)

    def decorated(test):
        @functools.wraps(test)
        def tried(**fixtures):
            failed = []
            for k, row in enumerate(rows):
                given = dict(fixtures)
                if "tmp_path" in given:
                    given["tmp_path"] = given["tmp_path"] / f"row_{k}"
                    given["tmp_path"].mkdir()
                if "capsys" in given:
                    given["capsys"].readouterr()
                try:
                    test(**given, **dict(zip(names, row if len(names) > 1 else (row,), strict=True)))
                except (Exception, pytest.fail.Exception) as error:
                    failed.append((row, error))
            if failed:
                listed = "\n".join(f"{str(row)[:200]}: {type(error).__name__}: {error}" for row, error in failed)
                raise AssertionError(f"{len(failed)} of {len(rows)} rows:\n{listed}") from failed[0][1]

        kept = [p for name, p in inspect.signature(test).parameters.items() if name not in names]
        tried.__signature__ = inspect.Signature(kept)
        del tried.__wrapped__
        return tried

    return decorated
