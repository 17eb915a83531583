"""The page of a report in a real browser: it opens offline, asks for nothing, and says what the run says."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from faulty import faulty_run
from pages import HOSTILE, chromium, drive, pages, violations

from graph_slam_ros import cli
from graph_slam_ros.analysis.explain import change_text, explain_edge, fields_of, statements, title
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.runs.ledger_file import read_ledger
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import Config


@pytest.fixture(scope="module")
def browser():
    with chromium() as browser:
        yield browser


@pytest.fixture
def opened(browser):
    with pages(browser) as go:
        yield lambda file, *words, **options: go(file.as_uri(), *words, **options)


@pytest.fixture(scope="module")
def page(browser, faulty):
    """The page of a drive with false closures, dark, at one of them."""
    false = next(e for e in read_ledger(faulty.run) if e.label == "closures" and not e.is_in)
    with pages(browser) as go:
        yield go(faulty.html.as_uri(), f"#edge={false.edge}", color_scheme="dark")


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faulty")
    run = faulty_run(folder)[1]
    truth = folder / "drive.mcap"
    assert cli.main(["report", str(run), "--truth", str(truth), "--out", str(folder / "run.html")]) == 0
    return SimpleNamespace(run=run, html=folder / "run.html", saved=SavedGraph(run, []))


def reported(run, out, *words):
    code = cli.main(["report", str(run), "--out", str(out), *map(str, words)])
    return code, out


def why(page):
    return " ".join(page.inner_text("#why-body").split())


def ranges(page):
    return page.evaluate("() => ['xaxis', 'yaxis'].flatMap(one => byId('map')._fullLayout[one].range)")


def test_a_page_says_why_as_explain_does(page, faulty):
    """By its address, by a row of the ledger, and by a click on the map."""
    false = next(e for e in read_ledger(faulty.run) if e.label == "closures" and not e.is_in)
    told = " ".join(" ".join(explain_edge(faulty.saved, str(false.edge))).split())
    assert why(page).startswith(told[: told.index(" what if ")])
    assert f"graph_slam explain run --with {false.edge}" in why(page)
    page.fill("#filter", f"{false.edge + 1}")
    before = ranges(page)
    page.click(f".row[data-edge='{false.edge + 1}']")
    other = faulty.saved.edge(false.edge + 1)
    assert title(other, faulty.saved).format(**fields_of(faulty.saved, other)) in why(page)
    assert ranges(page) == pytest.approx(before), "an edge that is seen does not move the map"
    page.evaluate("() => Plotly.relayout('map', {'xaxis.range': [900, 910], 'yaxis.range': [900, 910]})")
    page.evaluate("which => go('edge', which)", false.edge)
    page.wait_for_function("() => byId('map')._fullLayout.xaxis.range[0] < 900")
    page.click("#whole")
    assert ranges(page) == pytest.approx(before)
    page.evaluate("() => byId('map').emit('plotly_click', {points: [{data: {meta: 'keyframe'}, customdata: 5}]})")
    page.wait_for_function("() => document.getElementById('why-body').innerText.startsWith('keyframe 5:')")
    assert page.evaluate("location.hash") == "#keyframe=5"


def test_each_sentence_of_the_page_is_explains(page, faulty):
    """Of every edge: numbers may differ by one in their last digit, as they are packed."""
    shown = page.evaluate("() => Array.from({length: data.edges.count}, (_, k) => explained(k))")
    number = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]\d+)?")
    for e, found in zip(faulty.saved.entries, shown, strict=True):
        history, fields = [one for one in faulty.saved.changes if one.edge == e.edge], fields_of(faulty.saved, e)
        told = statements(e, faulty.saved, is_changed=bool(history))
        expected = [(what, text.format(**fields)) for what, text in told]
        expected += [("changed", change_text(one)) for one in history]
        lines = [tuple(line) for line in found["lines"] if line[0] not in ("what if", "to change")]
        assert found["title"] == title(e, faulty.saved).format(**fields)
        assert [what for what, _ in lines] == [what for what, _ in expected]
        for (_, text), (_, other) in zip(lines, expected, strict=True):
            assert number.sub("#", text) == number.sub("#", other)
            a, b = (np.array(number.findall(one), dtype=float) for one in (text, other))
            assert a == pytest.approx(b, rel=1.1e-3, abs=1.1e-2)


def test_the_slider_shows_the_estimate_as_it_was_known_then(page, faulty):
    assert page.inner_text("#when").startswith("now")
    then = "() => byId('map').data.find(one => one.meta === 'then').x.length"
    assert page.evaluate(then) == 0
    page.evaluate("() => { byId('time').value = 20; byId('time').dispatchEvent(new Event('input')); }")
    assert re.match(r"as known at keyframe \d+, [\d.]+ s after the start", page.inner_text("#when"))
    page.wait_for_function(f"({then})() > 1")
    count = "() => byId('map').data.find(one => one.meta === 'marks then').x.length"
    marks = page.wait_for_function(count).json_value()
    first = page.evaluate("() => data.drive.frames[20].keyframes")
    seen = {e.landmark for e in faulty.saved.entries if e.landmark and e.keyframe < first}
    assert 0 < marks <= len(seen)
    page.focus("#time")
    page.keyboard.press("End")
    assert page.inner_text("#when").startswith("now")


def test_the_ledger_filters_sorts_and_is_walked_with_arrow_keys(page, faulty):
    entries = read_ledger(faulty.run)
    page.fill("#filter", "")
    assert page.inner_text("#count") == f"{len(entries)} of {len(entries)} edges"
    page.fill("#filter", "closures held back")
    pending = [e.edge for e in entries if e.label == "closures" and e.verdict.name == "PENDING"]
    assert page.inner_text("#count") == f"{len(pending)} of {len(entries)} edges"
    page.click("#head button:has-text('judged')")
    statistic = [e.statistic for e in entries]
    rows = page.evaluate("() => [...document.querySelectorAll('.row')].map(row => Number(row.dataset.edge))")
    assert rows == sorted(pending, key=lambda edge: statistic[edge])[: len(rows)]
    page.evaluate("() => { location.hash = '#edge=1'; }")  # odometry, which is not among them
    page.wait_for_function("() => ledger.chosen === 1")
    page.focus("#rows")
    page.keyboard.press("ArrowDown")
    page.wait_for_function("edge => location.hash === `#edge=${edge}`", arg=rows[0])
    page.keyboard.press("ArrowDown")
    page.wait_for_function("edge => location.hash === `#edge=${edge}`", arg=rows[1])


def test_the_first_screen_has_verdict_and_path_axe_finds_nothing_wrong_and_charts_space_and_paper_are_drawn(
    page, faulty
):
    assert re.fullmatch(r"drive\.mcap, \d\d \w+ \d{4}, \d\d:\d\d UTC", page.inner_text("#title"))
    assert page.inner_text("#verdict strong") in ("Do not rely on this map yet", "Use this map with care")
    visible = "() => byId('map').data.filter((one) => one.name.startsWith('sightings')).map((one) => one.visible)"
    assert set(page.evaluate(visible)) == {"legendonly"}
    assert violations(page) == []
    page.set_viewport_size({"width": 390, "height": 844})
    page.wait_for_function("() => document.documentElement.scrollWidth <= 390")
    page.set_viewport_size({"width": 1400, "height": 900})
    page.click("#view")
    page.wait_for_function("() => byId('map').data.some(one => one.type === 'scatter3d')")
    page.evaluate("() => dispatchEvent(new Event('beforeprint'))")
    page.wait_for_function("() => [...document.querySelectorAll('#charts .plot')].every(one => one.data)")
    assert page.evaluate("() => byId('chi2-plots').children.length") > 1
    assert "RMSE" in page.inner_text("#verdict")
    assert page.evaluate("() => byId('chart-load').data[1].name") == "memory [MiB]"
    assert page.evaluate("() => getComputedStyle(document.body).backgroundColor") == "rgb(22, 25, 29)"
    page.click("#view")
    page.evaluate("() => dispatchEvent(new Event('beforeprint'))")
    sizes = "() => [...document.querySelectorAll('.plot')].map((one) => one._fullLayout.width)"
    colour = "() => ['map', 'chart-verdicts'].map((id) => document.getElementById(id)._fullLayout.paper_bgcolor)"
    assert page.evaluate(colour) == ["#ffffff"] * 2, "paper is light, and the page dark"
    assert set(page.evaluate(sizes)) == {680}
    page.evaluate("() => dispatchEvent(new Event('afterprint'))")
    page.wait_for_function(f"() => !({colour})().includes('#ffffff')")


def test_hostile_names_are_shown_as_text(opened, tmp_path, capsys):
    run = drive(tmp_path / "<b>&'run", HOSTILE)
    code, html = reported(run, tmp_path / "hostile.html")
    assert code == 0
    page = opened(html, "#edge=25")
    assert page.title() == "<b>&'run"
    assert page.locator("#verdict b, #why-body img, #why-body script, #space img, .plot a[href*=example]").count() == 0
    names = page.evaluate("() => column(data.edges.landmark_names)")
    assert names[:3] == HOSTILE[:3]
    assert names[3] == "\\u202eright to left\\u200b"
    assert len(names[4]) == 200
    for name in names:
        page.evaluate("name => go('landmark', name)", name)
        shown = "name => byId('why-body').innerText.startsWith(`landmark ${name.slice(0, 100)}`)"
        page.wait_for_function(shown, arg=name)
    assert page.title() == "<b>&'run"


def test_a_run_in_space_a_merged_and_frozen_one_and_an_empty_one_open(opened, tmp_path, capsys):
    space = drive(tmp_path / "space", ["a", "b", "c"], dimensions=3)
    code, html = reported(space, tmp_path / "space.html")
    page = opened(html, "#landmark=b")
    assert (code, page.evaluate("() => byId('map').data[0].type")) == (0, "scatter3d")
    assert why(page).startswith("landmark b: 20 edges")
    one, two = (drive(tmp_path / name, ["a", "b", "c", name], at) for name, at in (("one", 0), ("two", 100)))
    both, site = tmp_path / "both", tmp_path / "site"
    assert cli.main(["map", "merge", str(one), str(two), "--out", str(both)]) == 0
    assert cli.main(["map", "freeze", str(both), "--out", str(site)]) == 0
    code, html = reported(site, tmp_path / "site.html", "--compare", one)
    page = opened(html, "#keyframe=30")
    assert code == 0
    assert why(page).startswith("keyframe 30: ")
    assert "Compared with one" in page.inner_text("#compared-section")
    recorder = RunRecorder(tmp_path / "empty", Config())
    recorder.close()
    code, html = reported(tmp_path / "empty", tmp_path / "empty.html")
    page = opened(html)
    assert code == 3
    assert page.inner_text("#verdict").startswith("There is no map to show")
    assert not page.is_visible("#map")
