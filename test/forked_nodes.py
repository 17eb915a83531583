"""Nodes and commands for tests, forked from one process that has Python and the kernels: a quarter of the work.

What one does from its ``main``, or the import of rclpy, which starts threads, to the end of the interpreter is its own.
One whose start is the subject of a test is started by a command (``live_nodes.Started``).
"""

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile

MODULES = {"graph_slam": "graph_slam_ros.cli", "node": "graph_slam_ros.node.node"}
LONGEST = 2**16  # of a message: some parameters
DRAWN_WITH = "graph_slam_ros.analysis.plots", "matplotlib.figure", "matplotlib.backends.backend_agg"
CAN_DIFFER = {"ROS_DOMAIN_ID"}  # all else may have been read when modules were imported


class Forked:
    """As ``subprocess.Popen``, of a child of another process."""

    def __init__(self, command, pid, status, stderr=None):
        self.args, self.pid, self.stderr, self.returncode = command, pid, stderr, None
        self._status = status

    def poll(self):
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout=None):
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(self.args, timeout)
            self.returncode = int(os.read(self._status, 20))
            os.close(self._status)
        return self.returncode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)


class Server:
    """The process that forks; it ends with this one."""

    def __init__(self, environment):
        self._environment = dict(environment)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, __file__, str(theirs.fileno())]
            self._process = subprocess.Popen(
                command, env=self._environment, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()]
            )

    def can_fork(self, environment):
        """Whether what is started with this environment may have been forked from one of ours."""
        different = dict(self._environment.items() ^ environment.items())
        return different.keys() <= CAN_DIFFER

    def run(self, command, environment, timeout):
        """As ``subprocess.run``, of a command whose output is kept."""
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            process = self._started(command, environment, None, out.fileno(), err.fileno())
            try:
                code = process.wait(timeout)
            finally:
                process.kill()
            for file in (out, err):
                file.seek(0)
            return subprocess.CompletedProcess(command, code, out.read(), err.read())

    def start(self, command, environment, cwd=None):
        """As ``subprocess.Popen``, of a command whose stderr is kept."""
        said, stderr = os.pipe()
        try:
            process = self._started(command, environment, cwd, 1, stderr)
        finally:
            os.close(stderr)
        process.stderr = os.fdopen(said)
        return process

    def _started(self, command, environment, cwd, out, err):
        status, ended = os.pipe()
        own = {name: environment[name] for name in CAN_DIFFER & environment.keys()}
        asked = {"command": command, "environment": own, "cwd": str(cwd or os.getcwd())}
        socket.send_fds(self._socket, [json.dumps(asked).encode()], [out, err, ended])
        os.close(ended)
        answer = self._socket.recv(LONGEST)
        assert answer, f"the process that forks nodes has ended: {self._process.wait()}"
        return Forked(command, int(answer), status)


def serve(asked):
    """Fork for each request; returns in the child, with its command, and never in this process."""
    waiting, (wakes, woken) = {}, os.pipe()  # where to say how each child ended
    os.set_blocking(woken, False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the tests, and they end this
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(woken, warn_on_full_buffer=False)
    while True:
        ready, _, _ = select.select([asked, wakes], [], [])
        if wakes in ready:
            os.read(wakes, 100)
        for pid in list(waiting):
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                ended = waiting.pop(pid)
                with contextlib.suppress(BrokenPipeError):  # nobody asks any more
                    os.write(ended, str(os.waitstatus_to_exitcode(status)).encode())
                os.close(ended)
        if asked not in ready:
            continue
        data, fds, _, _ = socket.recv_fds(asked, LONGEST, 3)
        if not data:
            os._exit(0)
        out, err, ended = fds
        pid = os.fork()
        if not pid:
            os.dup2(out, 1)
            os.dup2(err, 2)
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for fd in (*fds, wakes, woken, *waiting.values()):
                os.close(fd)
            asked.close()
            request = json.loads(data)
            os.environ.update(request["environment"])
            os.chdir(request["cwd"])
            return request["command"]
        os.close(out)
        os.close(err)
        waiting[pid] = ended
        asked.send(str(pid).encode())


def main():
    """What a node imports, but for ROS; then, in each child, the node or the command."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the node does
    for name in ("graph_slam_ros.cli", "graph_slam_ros.runs.replay", "graph_slam_ros.node.session", *DRAWN_WITH):
        importlib.import_module(name)
    from graph_slam_ros.messages.interfaces import typestore
    from graph_slam_ros.warmup import warmup

    warmup()
    typestore()
    threads = len(os.listdir("/proc/self/task"))
    assert threads == 1, f"{threads} threads: their locks would be held for ever in the children"
    gc.collect()
    gc.freeze()  # the children share it
    sys.argv = serve(socket.socket(fileno=int(sys.argv[1])))
    return importlib.import_module(MODULES[sys.argv[0]]).main()


if __name__ == "__main__":
    sys.exit(main())
