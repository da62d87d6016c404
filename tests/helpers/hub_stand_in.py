"""A stand-in for the hub's HTTP interface on this machine: what huggingface_hub sends is kept, what it asks for is served."""

import base64
import hashlib
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit


class Hub:
    """
    :param files: Repository -> name -> content; grows by what is committed
    """

    def __init__(self, files=None):
        self.files = {repo: dict(content) for repo, content in (files or {}).items()}
        self.requests = []
        hub = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self):
                hub.answer(self, self.rfile.read(int(self.headers.get("Content-Length", 0))))

            def do_GET(self):
                hub.answer(self, b"")

            do_HEAD = do_GET

            def log_message(self, *_):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"

    def __enter__(self):
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_):
        self.server.shutdown()
        self.server.server_close()

    def answer(self, request, body):
        path = unquote(urlsplit(request.path).path)
        self.requests.append((request.command, path, request.headers.get("Authorization")))
        if path == "/api/repos/create":
            sent = json.loads(body)
            repo = "/".join(filter(None, (sent.get("organization"), sent["name"])))
            self.files.setdefault(repo, {})
            return self.send(request, {"url": f"{self.url}/{repo}"})
        if path == "/api/validate-yaml":
            return self.send(request, {"errors": [], "warnings": []})
        if path.startswith("/api/models/"):
            return self.answer_model(request, path.removeprefix("/api/models/").split("/"), body)
        repo, _, name = path.strip("/").partition("/resolve/main/")
        content = self.files.get(repo, {}).get(name)
        if content is None:
            code = "EntryNotFound" if repo in self.files else "RepoNotFound"
            return self.send(request, {"error": "not found"}, 404, {"X-Error-Code": code})
        headers = {"ETag": f'"{hashlib.sha1(content).hexdigest()}"', "X-Repo-Commit": "0" * 40, "Accept-Ranges": "bytes"}
        return self.send(request, content, 200, headers)

    def answer_model(self, request, parts, body):
        repo = "/".join(parts[:2])
        if repo not in self.files:
            return self.send(request, {"error": "not found"}, 404, {"X-Error-Code": "RepoNotFound"})
        if parts[2:3] == ["preupload"]:
            asked = json.loads(body)["files"]
            modes = [{"path": one["path"], "uploadMode": "regular", "shouldIgnore": False, "oid": None} for one in asked]
            return self.send(request, {"files": modes})
        if parts[2:3] == ["commit"]:
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    assert line["value"]["encoding"] == "base64"
                    self.files[repo][line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            url = f"{self.url}/{repo}/commit/{'0' * 40}"
            return self.send(request, {"success": True, "commitOid": "0" * 40, "commitUrl": url, "hookOutput": ""})
        siblings = [{"rfilename": name, "size": len(content)} for name, content in self.files[repo].items()]
        return self.send(
            request, {"id": repo, "modelId": repo, "sha": "0" * 40, "siblings": siblings, "tags": [], "private": False}
        )

    @staticmethod
    def send(request, content, status=200, headers=()):
        if not isinstance(content, bytes):
            content = json.dumps(content).encode()
        request.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **dict(headers)}.items():
            request.send_header(name, value)
        request.end_headers()
        if request.command != "HEAD":
            request.wfile.write(content)
