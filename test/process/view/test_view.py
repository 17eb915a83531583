"""The page of a run in a real browser, and its server attacked: X4 to X7 of docs/reliability.md."""

import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager, suppress
from types import SimpleNamespace

import numpy as np
import planted_closures
import pytest
from faulty import faulty_run
from pages import HOSTILE, chromium, drive, pages, violations

from graph_slam_ros import cli
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.graph import Loss
from graph_slam_ros.maps.edit import edit, read_plan
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.restore import restored
from graph_slam_ros.runs.trajectory import read_tum
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.report.contents import read_contents

pytest.importorskip("starlette", reason="view is tested with its extra: pip install 'graph_slam_ros[view]'")
pytest.importorskip("uvicorn", reason="view is tested with its extra: pip install 'graph_slam_ros[view]'")

from graph_slam_ros.tools.view import server
from graph_slam_ros.tools.view.server import Access, page_of
from graph_slam_ros.tools.view.workbench import Workbench


@contextmanager
def served(run, page=None):
    """A server of a run in this process, as the command starts it."""
    made = read_contents(run)
    work = Workbench(made, 3.0)
    bound = server.listening(0)
    access = Access(bound.getsockname()[1])
    one = server.server(server.application(work, page or page_of(made, work), access))
    thread = threading.Thread(target=one.run, args=([bound],))
    thread.start()
    try:
        yield SimpleNamespace(access=access, port=access.port, work=work, run=run)
    finally:
        one.should_exit = True
        thread.join(10.0)
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    return faulty_run(tmp_path_factory.mktemp("view"))[1]


@pytest.fixture(scope="module")
def attacked(faulty):
    with served(faulty, "<!DOCTYPE html>the page") as one:
        yield one


@pytest.fixture(scope="module")
def browser():
    with chromium() as browser:
        yield browser


def asked(one, method="GET", path="/", body=None, **headers):
    """Status, headers and body of an answer; the key of the page is sent, unless another is."""
    names = {"host": f"127.0.0.1:{one.port}", "cookie": f"{one.access.cookie}={one.access.key}"}
    if method == "POST":
        names |= {"origin": f"http://127.0.0.1:{one.port}", "content-type": "application/json"}
    names |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", one.port, timeout=10)
    try:
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in names.items():
            if value is not None:
                connection.putheader(name, value)
        if body is not None:
            connection.putheader("content-length", str(len(body)))
        connection.endheaders()
        if body is not None:
            connection.send(body)
        answer = connection.getresponse()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    finally:
        connection.close()


QUESTION = b'{"without": [], "let_in": [], "loss": "none", "first": false}'


def test_X4_it_listens_on_the_loopback_address_alone(attacked):
    assert asked(attacked)[0] == 200
    with pytest.raises(ConnectionRefusedError):  # as from another machine: a socket on all addresses has this one, too
        socket.create_connection(("127.0.0.2", attacked.port), timeout=5)
    with socket.socket(socket.AF_INET6) as six, pytest.raises(OSError):
        six.settimeout(5)
        six.connect(("::1", attacked.port))


def test_X5_a_page_that_is_not_its_own_gets_no_answer(attacked):
    port, key = attacked.port, attacked.access.key
    own, cookie = f"127.0.0.1:{port}", f"graph_slam_view_{port}="
    origins = "http://example.org", "null", None, f"https://{own}", "http://127.0.0.1:1", f"http://{own}.example.org"
    for name, values in {
        "origin": (*origins, f"http://user@{own}"),
        "sec_fetch_site": ("cross-site", "same-site"),
        "content_type": ("text/plain", None),
        "cookie": (None, cookie, f"{cookie}x", f"{cookie}\xff", f"graph_slam_view_1={key}"),
    }.items():
        for value in values:
            given = {name: value and value.encode("latin-1")}
            status, found, body = asked(attacked, "POST", "/solve", QUESTION, **given)
            assert status in (403, 415), given
            assert not [name for name in found if name.startswith("access-control")]
            assert len(body) < 200 and b"chi2" not in body


def test_X5_what_is_its_own_gets_one_that_no_other_page_may_read(attacked):
    status, found, body = asked(attacked, "POST", "/solve", QUESTION)
    assert status == 200 and "chi2" in json.loads(body)
    assert not [name for name in found if name.startswith("access-control")]
    assert found["cache-control"] == "no-store" and found["x-frame-options"] == "DENY"
    assert found["cross-origin-resource-policy"] == "same-origin"
    for method in ("OPTIONS", "PUT", "DELETE", "TRACE"):
        assert asked(attacked, method, "/solve")[0] == 405
    upgrade = {"connection": "Upgrade", "upgrade": "websocket", "sec_websocket_key": "x", "sec_websocket_version": "13"}
    assert asked(attacked, "GET", "/", origin="http://example.org", **upgrade)[0] == 403


def test_X5_the_token_opens_the_page_once(faulty, attacked):
    one = SimpleNamespace(port=attacked.port, access=Access(attacked.port))
    assert asked(one)[0] == 403, "the cookie of another start"
    for token in ("", "x", one.access.token, "\xe4"):
        path = f"/?token={token.encode('latin-1').hex() if token == chr(228) else token}"
        assert asked(attacked, "GET", path, cookie=None)[0] == 403
    assert asked(attacked, "POST", f"/?token={attacked.access.token}", b"", cookie=None)[0] == 403
    token = attacked.access.token
    status, found, body = asked(attacked, "GET", f"/?token={token}", cookie=None)
    assert status == 200 and body.startswith(b"<!DOCTYPE html>")
    assert re.fullmatch(rf"graph_slam_view_{one.port}=\S+; Path=/; HttpOnly; SameSite=Strict", found["set-cookie"])
    status, found, body = asked(attacked, "GET", f"/?token={token}", cookie=None)
    assert (status, "set-cookie" in found) == (403, False)
    assert b"graph_slam view" in body


def test_X6_a_name_that_was_made_to_point_here_is_refused(attacked):
    for host in (
        *("example.org", "example.org:{port}", "127.0.0.1", "127.0.0.1:1", "localhost", "127.0.0.1.nip.io:{port}"),
        *("", "[::1", "127.0.0.1:{port}@example.org", "user@127.0.0.1:{port}", "127.0.0.1:{port}/x", "0.0.0.0:{port}"),
        *("192.168.1.7:{port}", "127.0.0.1:99999", "127.0.0.1:{port}x", None),
    ):
        name = host and host.format(port=attacked.port)
        for method, path in (("GET", "/"), ("GET", f"/?token={attacked.access.token}"), ("POST", "/solve")):
            # Without Host the server answers and closes before it reads a body, whose rest may reset the answer.
            body = QUESTION if method == "POST" and name is not None else None
            assert asked(attacked, method, path, body, host=name)[0] in (400, 403), (host, method)
    assert asked(attacked, host=f"localhost:{attacked.port}")[0] == 200


def test_no_path_leads_anywhere_else(attacked):
    for path in ("/etc/passwd", "/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/save", "/x" * 4000):
        assert asked(attacked, "GET", path)[0] in (404, 405)
    for path in ("/", "/etc/passwd", "/save/../../x"):
        assert asked(attacked, "POST", path, QUESTION)[0] in (404, 405)


def raw(one, *parts):
    """What is answered to some bytes, until the connection is closed."""
    with socket.create_connection(("127.0.0.1", one.port), timeout=10) as client:
        for part in parts:
            client.sendall(part)
        got = b""
        with suppress(ConnectionResetError):  # it does not read what it has refused
            while more := client.recv(65536):
                got += more
    return got


def test_X7_large_bodies_and_heads_are_refused(attacked):
    def head(*lines):
        known = f"host: 127.0.0.1:{attacked.port}", f"cookie: {attacked.access.cookie}={attacked.access.key}"
        own = f"origin: http://127.0.0.1:{attacked.port}", "content-type: application/json"
        return "\r\n".join(["POST /solve HTTP/1.1", *known, *own, *lines, "", ""]).encode()

    large = b"x" * (server.MOST_BYTES + 1)
    assert asked(attacked, "POST", "/solve", large)[0] == 413
    assert b" 413 " in raw(attacked, head("content-length: 999999999999", "connection: close"))
    chunks = [b"10000\r\n" + 65536 * b"x" + b"\r\n" for _ in range(17)]
    found = raw(attacked, head("transfer-encoding: chunked", "connection: close"), *chunks, b"0\r\n\r\n")
    assert found == b"" or b" 413 " in found
    assert b" 400 " in raw(attacked, b"GET / HTTP/1.1\r\nx: " + 40_000 * b"x")
    assert asked(attacked, "POST", "/solve", b"x" * server.MOST_BYTES)[0] == 422
    assert asked(attacked)[0] == 200


def estimate(page):
    return np.array(page.evaluate("() => estimate().map((axis) => [...axis])")).T


def solved(page):
    page.wait_for_function("() => document.body.dataset.solved === String(edits.asked)")


def test_an_edge_is_unchecked_solved_undone_and_saved(browser, faulty, tmp_path):
    saved = SavedGraph(faulty, [])
    edge = [e.edge for e in saved.entries if e.is_in and e.label == "landmarks"][7]
    back = next(e.edge for e in saved.entries if not e.is_in and e.label == "closures")
    with served(faulty) as one, pages(browser, offline=False) as go:
        page = go(one.access.address, f"#edge={edge}")
        assert "token" not in page.url
        before = estimate(page)
        page.click("#is-in")
        solved(page)
        page.evaluate("edge => go('edge', edge)", back)
        page.check("#is-in")
        solved(page)
        page.click("#more summary")
        page.select_option("#loss", "cauchy")
        solved(page)
        both = saved.solve([edge], [back], Loss.named("cauchy", 3.0)).estimate(saved.keyframes)
        assert estimate(page)[:, :2] == pytest.approx(both[:, :2], abs=1e-5)
        assert np.abs(both[:, :2] - before[:, :2]).max() > 5e-4
        page.select_option("#loss", "")
        solved(page)
        page.click("#undo")
        solved(page)
        page.fill("#who", "Anna")
        page.click("#save")
        assert "Reason is empty" in page.inner_text("#saved")
        page.fill("#reason", "it looks wrong")
        with page.expect_download() as download:
            page.click("#download")
        download.value.save_as(tmp_path / "edits.json")
        page.click("#save")
        page.wait_for_function("() => byId('saved').innerText.startsWith('Saved in')")
        folder = faulty.with_name("run_edited")
        assert str(folder) in page.inner_text("#saved")
        edited = edit(faulty, read_plan(tmp_path / "edits.json"), tmp_path / "other")
        for name in ("path.tum", "ledger.csv"):
            assert (folder / name).read_bytes() == (tmp_path / "other" / name).read_bytes()
        assert [one.edit.who for one in edited.edits] == ["Anna"]
        assert estimate(page) == pytest.approx(read_tum(folder / "path.tum").poses[:, :3], abs=1e-5)
        page.reload()  # by its cookie, without the token
        page.wait_for_selector("body[data-ready=yes]")
        assert estimate(page) == pytest.approx(before, abs=2e-3)


def test_a_map_is_repaired_by_what_the_page_says(browser, tmp_path):
    """A group of closures that agree with one another is taken out as docs/repair.md shows it."""
    wrong = planted_closures.run(tmp_path / "run")
    with served(tmp_path / "run") as one, pages(browser, offline=False) as go:
        page = go(one.access.address)
        page.click("#verdict a")
        boxes = page.locator("#groups input")
        assert boxes.count() == 2
        for k in (0, 0, 1):  # as a person who looks at the map without either
            boxes.nth(k).click()
            page.wait_for_selector("body:not([data-solved=no])")
        assert [boxes.nth(k).is_checked() for k in (0, 1)] == [False, True]
        assert "keyframe 54 moves most, by 4.03" in page.inner_text("#effect")
        assert page.locator("#effect p").count() == 1, "both ways to solve agree"
        assert page.inner_text("#sum") == "4 closures taken out"
        page.evaluate("edge => go('edge', edge)", wrong[0])
        page.wait_for_function("() => byId('why-body').innerText.includes('taken out (not saved)')")
        assert "one of a group of 4" in page.inner_text("#why-body")
        assert "closures, taken out (not saved)" in page.evaluate("() => byId('map').data.map(one => one.name)")
        page.fill("#who", "Anna")
        page.fill("#reason", "the fourth aisle was taken for the second")
        page.click("#save")
        page.wait_for_function("document.getElementById('saved').innerText.startsWith('Saved')")
        assert "The saved map: " in page.inner_text("#saved")
    assert sorted(e.edit.values["edge"] for e in restored(tmp_path / "run_edited", []).view.edits) == sorted(wrong[:4])


def test_a_closure_is_dragged_and_axe_finds_nothing_wrong(browser, faulty):
    with served(faulty) as one, pages(browser, offline=False) as go:
        page = go(one.access.address, "#keyframe=30")
        page.click("#actions button:has-text('add closure')")
        page.fill("#fields input[name=from_keyframe]", "5")
        page.fill("#fields input[name=to_keyframe]", "30")
        page.wait_for_function("() => (byId('map').layout.shapes || []).length === 1")
        start, end, place = page.evaluate("""() => {
            byId('map').scrollIntoView({block: 'center'});
            const {xaxis, yaxis} = byId('map')._fullLayout, box = byId('map').getBoundingClientRect();
            const [x, y] = estimate().map((axis) => axis[30]), at = [x + 3, y + 2];
            const pixel = (a, b) => [box.left + xaxis._offset + xaxis.l2p(a), box.top + yaxis._offset + yaxis.l2p(b)];
            return [pixel(x, y), pixel(...at), at];
        }""")
        page.mouse.move(*start)
        page.mouse.down()
        page.mouse.move(*end, steps=5)
        page.mouse.up()
        page.wait_for_function("() => field('pose').value")
        pose = [float(number) for number in page.input_value("#fields input[name=pose]").split(",")]
        saved = SavedGraph(faulty, [])
        (x, y, turn), (_, _, other) = saved.view.solver.estimate([saved.keyframes[5], saved.keyframes[30]])
        c, s = np.cos(turn), np.sin(turn)
        assert x + c * pose[0] - s * pose[1] == pytest.approx(place[0], abs=0.3)
        assert y + s * pose[0] + c * pose[1] == pytest.approx(place[1], abs=0.3)
        assert np.cos(pose[2] - (other - turn)) == pytest.approx(1.0, abs=1e-5)
        page.fill("#fields input[name=sigma_m]", "0.1")
        page.fill("#fields input[name=sigma_rad]", "0.1")
        page.click("#new-edit button")
        solved(page)
        assert "against all else" in page.inner_text("#effect")
        assert violations(page) == []


def test_forms_make_edits_of_landmarks_and_hostile_names_are_text(browser, tmp_path):
    run = drive(tmp_path / "<b>&'run", HOSTILE)
    with served(run) as one, pages(browser, offline=False) as go:
        page = go(one.access.address, "#landmark=" + "%3Cscript%3Edocument.title%3D%27broken%27%3C%2Fscript%3E")
        page.click("#actions button:has-text('rename landmark')")
        page.click("#new-edit button")
        assert page.locator("#pending li").count() == 0, "a field is empty"
        page.fill("#fields input[name=to]", "<img src=x onerror=\"document.title='broken'\">")
        page.click("#new-edit button")
        solved(page)
        assert "As it would be saved" in page.inner_text("#effect")
        page.select_option("#kind", "merge_landmarks")
        page.fill("#fields input[name=landmark]", HOSTILE[1])
        page.fill("#fields input[name=into]", HOSTILE[2])
        page.click("#new-edit button")
        solved(page)
        assert page.locator("#pending li").count() == 2
        page.fill("#who", "<b>Anna</b>")
        page.fill("#reason", "<script>document.title='broken'</script>")
        page.click("#save")
        page.wait_for_function("() => byId('saved').innerText.startsWith('Saved in')")
        assert page.title() == "<b>&'run"
        assert page.locator("#edit-panel b, #edit-panel img, #edit-panel script").count() == 0
    edits = SavedGraph(run.with_name("<b>&'run_edited"), []).edits
    assert [one.edit.do for one in edits] == ["rename_landmark", "merge_landmarks"]
    assert [one.edit.arguments["landmark"] for one in edits] == HOSTILE[:2]


def test_the_command_prints_an_address_and_ends_with_ctrl_c(tmp_path, capsys):
    run = drive(tmp_path / "run", ["a", "b"], dimensions=3)
    command = [sys.executable, "-m", "graph_slam_ros.cli", "view", str(run), "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().strip()
        port = int(re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=\S{20,}", address)[1])
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", address[address.index("/?") :])
        answer = connection.getresponse()
        assert (answer.status, b"Edits" in answer.read()) == (200, True)
        assert cli.main(["view", str(run), "--no-browser", "--port", str(port)]) == 2
        out, error = capsys.readouterr()
        assert (out, error.count("\n")) == ("", 1) and f"127.0.0.1:{port}" in error
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=10)  # with a client that is still there
        assert (process.returncode, error) == (0, "")
        assert out.endswith("ended\n")
    finally:
        process.kill()
        process.communicate()


def test_what_cannot_be_shown_is_one_line_and_opens_no_socket(tmp_path, told, monkeypatch):
    def no_socket(*words):
        raise AssertionError("a socket")

    monkeypatch.setattr(server, "listening", no_socket)
    empty = tmp_path / "empty"
    RunRecorder(empty, Config()).close()
    damaged = drive(tmp_path / "damaged", ["a", "b"])
    (damaged / "map.mcap").write_bytes(b"nonsense")
    (damaged / "ingest.mcap").write_bytes(b"nonsense")
    for words in ([empty], [damaged], [tmp_path / "none"], [damaged, "--topic", "/x"], [damaged, "--port", "70000"]):
        code, out, err = told("view", *words, "--no-browser")
        assert (code, out, len(err.splitlines())) == (2, "", 1), (words, err)
