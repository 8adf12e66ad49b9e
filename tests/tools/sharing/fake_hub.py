"""A hub on loopback that keeps repositories in memory: what ``huggingface_hub`` asks of a server to
make a repository, put files into it and fetch them.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

Commits = dict[str, dict[str, bytes]]  # commit -> name of a file -> content, the oldest first


class FakeHub:
    """Repositories by name."""

    def __init__(self) -> None:
        self.repos: dict[str, Commits] = {}
        self.asked: list[str] = []
        self.token = ""

    def files(self, repo: str, revision: str = "main") -> tuple[str, dict[str, bytes]]:
        """Commit and files of a revision; a ``KeyError`` if there is none."""
        commits = self.repos[repo]
        commit = list(commits)[-1] if revision == "main" else revision
        return commit, commits[commit]

    def commit(self, repo: str, files: dict[str, bytes]) -> str:
        """Add files to the newest commit of a repository, as a new one."""
        commits = self.repos.setdefault(repo, {})
        before = list(commits.values())[-1] if commits else {}
        name = hashlib.sha1(f"{repo} {len(commits)}".encode()).hexdigest()
        commits[name] = before | files
        return name


class Handler(BaseHTTPRequestHandler):
    """Answers for a `FakeHub`."""

    hub: FakeHub

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_HEAD(self) -> None:
        self._file(with_body=False)

    def do_GET(self) -> None:
        if "/resolve/" in self.path:
            self._file(with_body=True)
        else:
            self._json(404, {"error": "not here"})

    def do_POST(self) -> None:
        self.hub.asked.append(f"POST {self.path}")
        self.hub.token = self.headers.get("Authorization", "")
        body = self._body()
        path = urlsplit(self.path).path
        if path == "/api/repos/create":
            about = json.loads(body)
            repo = f"{about['organization']}/{about['name']}"
            self.hub.repos.setdefault(repo, {}) or self.hub.commit(repo, {})
            self._json(200, {"url": f"{self._origin()}/{repo}", "id": repo, "name": repo})
        elif path == "/api/validate-yaml":
            self._json(200, {"errors": [], "warnings": []})
        elif "/preupload/" in path:
            names = [entry["path"] for entry in json.loads(body)["files"]]
            files = [{"path": n, "uploadMode": "regular", "shouldIgnore": False} for n in names]
            self._json(200, {"files": files})
        elif "/commit/" in path:
            repo = path.removeprefix("/api/models/").partition("/commit/")[0]
            added = {}
            for line in body.splitlines():
                entry = json.loads(line)
                if entry["key"] == "file":
                    value = entry["value"]
                    added[value["path"]] = base64.b64decode(value["content"])
            commit = self.hub.commit(repo, added)
            url = f"{self._origin()}/{repo}/commit/{commit}"
            self._json(200, {"success": True, "commitOid": commit, "commitUrl": url})
        else:
            self._json(404, {"error": f"nothing at {path}"})

    def _body(self) -> bytes:
        if "chunked" not in self.headers.get("Transfer-Encoding", ""):
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        parts = []
        while size := int(self.rfile.readline(), 16):
            parts.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(parts)

    def _file(self, with_body: bool) -> None:
        self.hub.asked.append(f"{self.command} {self.path}")
        repo, _, rest = unquote(urlsplit(self.path).path)[1:].partition("/resolve/")
        revision, _, name = rest.partition("/")
        try:
            commit, files = self.hub.files(repo, revision)
        except KeyError:
            self._json(404, {"error": "no such repository"}, {"X-Error-Code": "RepoNotFound"})
            return
        if name not in files:
            about = {"X-Error-Code": "EntryNotFound", "X-Repo-Commit": commit}
            self._json(404, {"error": "no such file"}, about)
            return
        data = files[name]
        self.send_response(200)
        self.send_header("X-Repo-Commit", commit)
        self.send_header("ETag", f'"{hashlib.sha1(data).hexdigest()}"')
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if with_body:
            self.wfile.write(data)

    def _json(self, status: int, value: object, headers: dict[str, str] | None = None) -> None:
        data = json.dumps(value).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        for name, text in (headers or {}).items():
            self.send_header(name, text)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _origin(self) -> str:
        return f"http://{self.headers['Host']}"


@contextmanager
def serving() -> Iterator[tuple[FakeHub, str]]:
    """A hub and its address."""
    hub = FakeHub()
    handler = type("OfOne", (Handler,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub, f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
