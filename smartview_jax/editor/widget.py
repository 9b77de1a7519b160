"""Show the editor's page in a notebook: the same files, over Jupyter's own connection.

A notebook's widget is a single script, so the page's modules are sent as texts and assembled in the
browser, each under its own address. Nothing is read from a network or another port, so it works
wherever the notebook does.
"""

import json
import re
from functools import cache
from typing import TYPE_CHECKING, Any

from ..extras import import_extra
from .conversation import Conversation
from .server import PAGE, encoded_picture
from .session import ModelSession

if TYPE_CHECKING:
    import anywidget

MODULES = (
    "vendor/three.core.min.js",
    "vendor/three.module.min.js",
    "vendor/OrbitControls.js",
    "model.js",
    "layout.js",
    "picture_view.js",
    "space_view.js",
    "connection.js",
    "editor.js",
)
"""The page's modules in order of import."""


@cache
def widget_script() -> str:
    """Return the widget's script: the page's modules as texts, and the code that starts them."""
    lines = ["const addresses = {};"]
    for name in MODULES:
        text = (PAGE / name).read_text(encoding="utf-8")
        # Names of imported modules are replaced by addresses, which are known only in the browser,
        # so the script concatenates texts and addresses.
        parts: list[str] = []
        end = 0
        for match in re.finditer(r"""(from ?|import ?)(["'])(three|\./[\w./]+)\2""", text):
            target = _module_named(match[3], name)
            parts += [json.dumps(text[end : match.start()] + match[1] + match[2])]
            parts += [f"addresses[{json.dumps(target)}]", json.dumps(match[2])]
            end = match.end()
        # JSON strings are valid in JavaScript.
        parts.append(json.dumps(text[end:]))
        lines.append(
            f"addresses[{json.dumps(name)}] = URL.createObjectURL("
            f'new Blob([{", ".join(parts)}], {{ type: "text/javascript" }}));'
        )
    return "\n".join([*lines, (PAGE / "widget.js").read_text(encoding="utf-8")])


def _module_named(specifier: str, importer: str) -> str:
    """Return the file of a module that another one imports."""
    if specifier == "three":
        return "vendor/three.module.min.js"
    folder = importer.rpartition("/")[0]
    name = specifier.removeprefix("./")
    return f"{folder}/{name}" if folder else name


def editor_widget(session: ModelSession) -> "anywidget.AnyWidget":
    """Return the editor of a session as a widget for a notebook.

    Changes made by the notebook's code appear in the page after `widget.refresh()`.

    Raises:
        ImportError: anywidget is not installed.
    """
    anywidget = import_extra("anywidget", "editor", "the editor in a notebook")
    conversation = Conversation(session)

    # Defined here, because anywidget is an optional import.
    class EditorWidget(anywidget.AnyWidget):
        """The editor's page in a notebook."""

        _esm = widget_script()
        _css = (PAGE / "style.css").read_text(encoding="utf-8")

        def __init__(self) -> None:
            super().__init__()
            self.on_msg(lambda _, message, __: self._answer(message))

        def _answer(self, message: dict[str, Any]) -> None:
            if message.get("do") == "picture" and message.get("view") in session.pictures:
                view = message["view"]
                data = encoded_picture(session.pictures[view])
                answer = {"type": "picture", "view": view, "reply_to": message.get("message")}
                self.send(answer, buffers=[data])
                return
            self.send(conversation.answer(message))

        def refresh(self) -> None:
            """Show the changes of the session since the last message to the page."""
            self.send(conversation.update())

    return EditorWidget()
