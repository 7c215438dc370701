"""The real yaml-language-server (npm), driven over standard input and output as an editor drives it."""

import json
import os
import shutil
import subprocess
from pathlib import Path

from outside import watched

COMMAND = os.environ.get("YAML_LANGUAGE_SERVER") or shutil.which("yaml-language-server")


class Server:
    """A session in a folder, with an editor's settings. `|` in a text is where the cursor is."""

    def __init__(self, folder, settings):
        self.folder, self.settings, self.count = Path(folder), settings, 0
        self.process = subprocess.Popen([COMMAND, "--stdio"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        with watched(self.process.kill):
            self.begin()

    def begin(self):
        folders = [{"uri": self.folder.as_uri(), "name": "here"}]
        item = {"snippetSupport": True, "documentationFormat": ["markdown"]}
        can = {"textDocument": {"completion": {"completionItem": item}, "hover": {"contentFormat": ["markdown"]}}}
        can["workspace"] = {"configuration": True, "workspaceFolders": True}
        asked = {"processId": None, "rootUri": self.folder.as_uri(), "workspaceFolders": folders, "capabilities": can}
        self.ask("initialize", asked)
        self.tell("initialized", {})
        self.tell("workspace/didChangeConfiguration", {"settings": self.settings})
        # It asks for the settings by itself, and knows no schema until it has them.
        while not self.diagnose(f"specs/first{self.count}.yaml", "no such section: 1\n"):
            self.count += 1

    def close(self):
        self.process.kill()
        self.process.communicate()

    def send(self, message):
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        self.process.stdin.write(b"Content-Length: %d\r\n\r\n" % len(body) + body)
        self.process.stdin.flush()

    def read(self):
        length = 0
        while (line := self.process.stdout.readline()) != b"\r\n":
            if not line:
                raise EOFError("yaml-language-server has ended, or did not answer in time")
            name, _, value = line.partition(b":")
            length = int(value) if name.lower() == b"content-length" else length
        return json.loads(self.process.stdout.read(length))

    def wait(self, wanted):
        with watched(self.process.kill):
            while True:
                message = self.read()
                if "method" in message and "id" in message:
                    self.send({"id": message["id"], "result": self.answer(message)})
                elif wanted(message):
                    return message

    def answer(self, message):
        if message["method"] != "workspace/configuration":
            return None
        return [self.settings.get(item.get("section"), {}) for item in message["params"]["items"]]

    def ask(self, method, params):
        self.count += 1
        number = self.count
        self.send({"id": number, "method": method, "params": params})
        return self.wait(lambda m: m.get("id") == number)["result"]

    def tell(self, method, params):
        self.send({"method": method, "params": params})

    def open(self, name, text):
        uri = (self.folder / name).as_uri()
        self.tell("textDocument/didOpen", {"textDocument": {"uri": uri, "languageId": "yaml", "version": 1, "text": text}})
        return uri

    def diagnose(self, name, text):
        """[(line, sentence)] of a file, lines counted from 1."""
        uri = self.open(name, text)
        found = self.wait(
            lambda m: m.get("method") == "textDocument/publishDiagnostics" and m["params"]["uri"] == uri,
        )
        self.tell("textDocument/didClose", {"textDocument": {"uri": uri}})
        return [(d["range"]["start"]["line"] + 1, d["message"]) for d in found["params"]["diagnostics"]]

    def at(self, name, text):
        before, _, after = text.partition("|")
        line = before.count("\n")
        position = {"line": line, "character": len(before) - (before.rfind("\n") + 1)}
        return {"textDocument": {"uri": self.open(name, before + after)}, "position": position}

    def complete(self, name, text):
        """label → item, of what is offered at the cursor."""
        found = self.ask("textDocument/completion", self.at(name, text))
        return {i["label"]: i for i in (found["items"] if isinstance(found, dict) else found or [])}

    def hover(self, name, text):
        """The words that are shown at the cursor."""
        found = self.ask("textDocument/hover", self.at(name, text))
        return found["contents"]["value"].replace("\\", "") if found else ""
