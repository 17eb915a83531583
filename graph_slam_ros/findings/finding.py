"""A finding: one thing that is wrong with a recording, a run or the node, or good to know."""

import math
import shlex
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from graph_slam_ros.findings.table import CHECKED, explain, remedy
from graph_slam_ros.formats.parameters import parse_setting

Severity: TypeAlias = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
_ASSUMED, _MEND_FIRST = "frame_unlinked", "mend what is above first, then check again"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong, or good to know.

    Attributes
    ----------
    code : its name, a row of the table
    severity : error: a replay fails or means nothing; warning: it is worse than it could be; note: good to know
    value, limit : what was measured, and from where on it is a finding, in ``unit``
    text : what was measured, in one sentence, or what the meaning of its row needs
    topic, first_ns, count : where: the topic, the first stamp (0: unknown), and how many messages or sightings
    settings : ``KEY=VALUE``, which together mend it; empty where no parameter does
    source : the input of the topic; empty where it is of none
    remedy : what mends it, where that is not what its row has; empty where the text has it
    follows : codes that follow from it, beyond those that its row hides
    """

    code: str
    severity: Severity
    value: float = math.nan
    limit: float = math.nan
    unit: str = ""
    text: str = ""
    topic: str = ""
    first_ns: int = 0
    count: int = 0
    settings: tuple[str, ...] = ()
    source: str = ""
    remedy: str | None = None
    follows: tuple[str, ...] = ()

    def __str__(self) -> str:
        mend = " ".join(f"--set {shlex.quote(text)}" for text in self.settings) or self.mend
        meaning = explain(self.code).meaning
        return f"{meaning.format(self) if '{' in meaning else self.text or meaning}{mend and ': '}{mend}"

    @property
    def mend(self) -> str:
        """Return what mends it beyond the settings, with the name of the input; empty where nothing is to be done."""
        return remedy(self.source, self.code).format(self) if self.remedy is None else self.remedy

    @property
    def hides(self) -> tuple[str, ...]:
        """Return the codes that are no finding of their own beside it."""
        return (*explain(self.code).hides, *self.follows)

    @property
    def ends(self) -> bool:
        """Return whether other findings mean nothing while it is there."""
        is_doubted = self.severity == "warning" and self.code == "odometry_scale"
        return explain(self.code).ends and self.severity != "note" and not is_doubted

    @property
    def forbids_replay(self) -> bool:
        """Return whether a replay is of no use until the cause is corrected: no setting mends it."""
        return self.severity == "error" and not self.settings and (self.ends or self.code not in CHECKED)

    def as_dict(self) -> dict[str, Any]:
        """Plain values; a number that JSON has not is null."""
        numbers = {"value": self.value, "limit": self.limit}
        finite = {name: float(x) if math.isfinite(x) else None for name, x in numbers.items()}
        evidence = {"topic": self.topic, "input": self.source, "first_ns": self.first_ns, "count": self.count}
        first = {"code": self.code, "severity": self.severity, **finite, "unit": self.unit}
        return first | {"evidence": evidence, "text": self.text, "settings": list(self.settings), "remedy": self.mend}


def causes(found: Iterable[Finding]) -> list[Finding]:
    """Return the findings without those that follow from others, which are at least as severe."""
    out = list(found)
    for one in out.copy():
        if one in out and one.severity != "note":
            worse = SEVERITIES[: SEVERITIES.index(one.severity)]
            out = [o for o in out if o is one or o.severity in worse or o.code not in one.hides]
    return out


def in_order(found: Iterable[Finding]) -> list[Finding]:
    """Errors first, then warnings, then notes, each in the order found, without what follows from others."""
    return sorted(causes(found), key=lambda one: SEVERITIES.index(one.severity))


def with_one_value(findings: list[Finding]) -> list[Finding]:
    """Findings that give each parameter one value: a later one that has another value for it prints no settings.

    A place that is only assumed, as nothing links its frame, gives way to one that was measured.
    """
    values, out = dict[str, tuple[Any, str]](), dict[int, Finding]()
    for k, one in sorted(enumerate(findings), key=lambda pair: pair[1].code == _ASSUMED):
        own = dict(parse_setting(text) for text in one.settings)
        others = [values[key][1] for key, value in own.items() if key in values and values[key][0] != value]
        if others:
            first = f"{others[0]} has the setting" if one.code == _ASSUMED else _MEND_FIRST
            out[k] = replace(one, settings=(), text=f"{one.text} ({first})")
        else:
            values |= {key: (value, one.code) for key, value in own.items()}
            out[k] = one
    return [out[k] for k in range(len(findings))]
