"""A stand-in for the Hugging Face Hub: the part of its API that one upload and one download need, in memory."""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

TOKEN = "hf_of_me"
OWNER = "me"


@dataclass
class Repository:
    """``commits``: hash to path to content, oldest first."""

    private: bool
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)

    def at(self, revision: str) -> tuple[str, dict[str, bytes]] | None:
        if revision == "main" and self.commits:
            revision = list(self.commits)[-1]
        return (revision, self.commits[revision]) if revision in self.commits else None


@dataclass
class Hub:
    """``large``: sha256 to content of files that were uploaded apart; ``asked``: methods and paths, in order."""

    url: str = ""
    repositories: dict[str, Repository] = field(default_factory=dict)
    large: dict[str, bytes] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)

    def commit(self, name: str, lines: list[dict[str, Any]]) -> str:
        repository = self.repositories[name]
        found = repository.at("main")
        files = dict(found[1]) if found else {}
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.large[value["oid"]]
        commit = hashlib.sha1(f"{len(repository.commits)}{sorted(files)}".encode()).hexdigest()
        repository.commits[commit] = files
        return commit


@contextmanager
def hub_server() -> Iterator[Hub]:
    """A Hub at ``url`` on this machine."""
    hub = Hub()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: Any) -> None:
            pass

        def answer(self, status: int, content: Any = None, **headers: str) -> None:
            body = content if isinstance(content, bytes) else json.dumps(content).encode()
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name.replace("_", "-"), value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        @property
        def is_me(self) -> bool:
            return self.headers.get("Authorization") == f"Bearer {TOKEN}"

        def do_HEAD(self) -> None:
            self.do_GET()

        def do_GET(self) -> None:
            hub.asked.append(f"{self.command} {self.path}")
            info = re.fullmatch(r"/api/models/([^/]+/[^/]+)", self.path)
            if info and info[1] in hub.repositories:
                self.answer(200, {"id": info[1], "private": hub.repositories[info[1]].private, "sha": "0" * 40})
                return
            asked = re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", self.path)
            repository = hub.repositories.get(asked[1]) if asked else None
            if asked is None or repository is None or (repository.private and not self.is_me):
                self.answer(401, {"error": "Repository not found"}, X_Error_Code="RepoNotFound")
                return
            found = repository.at(asked[2])
            if found is None:
                self.answer(404, {"error": "Invalid rev"}, X_Error_Code="RevisionNotFound")
            elif asked[3] not in found[1]:
                self.answer(404, {"error": "Entry not found"}, X_Error_Code="EntryNotFound", X_Repo_Commit=found[0])
            else:
                content = found[1][asked[3]]
                tag = f'"{hashlib.sha256(content).hexdigest()}"'
                self.answer(200, content, X_Repo_Commit=found[0], ETag=tag)

        def do_PUT(self) -> None:
            content = self.rfile.read(int(self.headers["Content-Length"]))
            hub.large[hashlib.sha256(content).hexdigest()] = content
            self.answer(200, {})

        def do_POST(self) -> None:
            hub.asked.append(f"{self.command} {self.path}")
            body = self.rfile.read(int(self.headers["Content-Length"]))
            if not self.is_me:
                self.answer(401, {"error": "Invalid user token."})
            elif self.path == "/api/repos/create":
                asked = json.loads(body)
                name = f"{asked['organization']}/{asked['name']}"
                if asked["organization"] != OWNER:
                    self.answer(403, {"error": "You don't have the rights to create a model\nunder this namespace"})
                elif name in hub.repositories:
                    self.answer(409, {"error": "You already created this model repo", "url": f"{hub.url}/{name}"})
                else:
                    is_private = asked.get("private") is True or asked.get("visibility") == "private"
                    hub.repositories[name] = Repository(is_private)
                    self.answer(200, {"url": f"{hub.url}/{name}", "name": name, "id": "1"})
            elif self.path == "/api/validate-yaml":
                self.answer(200, {"errors": [], "warnings": []})
            elif "/preupload/" in self.path:
                files = [
                    {"path": file["path"], "shouldIgnore": False,
                     "uploadMode": "lfs" if file["path"].endswith(".safetensors") else "regular"}
                    for file in json.loads(body)["files"]
                ]  # fmt: skip
                self.answer(200, {"files": files})
            elif self.path.endswith("/info/lfs/objects/batch"):
                objects = [
                    {"oid": entry["oid"], "size": entry["size"], "authenticated": True,
                     "actions": {"upload": {"href": f"{hub.url}/upload/{entry['oid']}", "header": {}}}}
                    for entry in json.loads(body)["objects"]
                ]  # fmt: skip
                self.answer(200, {"transfer": "basic", "objects": objects})
            elif "/commit/" in self.path:
                name = self.path.removeprefix("/api/models/").partition("/commit/")[0]
                commit = hub.commit(name, [json.loads(line) for line in body.splitlines()])
                self.answer(200, {"commitUrl": f"{hub.url}/{name}/commit/{commit}", "commitOid": commit})
            else:
                self.answer(404, {"error": f"the stand-in does not know {self.path}"})

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
