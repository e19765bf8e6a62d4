"""One HTML file with all that it shows in it: no other files, no scripts, nothing from the network.

Texts are escaped wherever they come from; what is HTML already is a `Html`.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tactile_base.whole_file import whole_file

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 1080px;
  margin: 0 auto; padding: 1.5rem 1.25rem 4rem; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .25rem; }
h2 { font-size: 1.15rem; margin: 2.25rem 0 .5rem; border-bottom: 1px solid #ddd; padding-bottom: .25rem; }
h3 { font-size: 1rem; margin: 1.5rem 0 .25rem; }
p { margin: .4rem 0; max-width: 75ch; }
.quiet { color: #5a5a5a; }
.good { color: #1d7a38; } .bad { color: #b3261e; font-weight: 600; } .open { color: #8a5a00; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .5rem 0 1rem; overflow-wrap: normal; }
th, td { padding: .2rem .9rem .2rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid #eee; }
th { font-weight: 600; color: #444; } td.number, th.number { text-align: right; white-space: nowrap; }
img { max-width: 100%; height: auto; margin: .5rem 0 1rem; }
code { font: .92em ui-monospace, monospace; background: #f4f4f2; padding: .1em .25em; }
"""


class Html(str):
    """Text that is HTML already."""


def element(name: str, *content: Any, **attributes: str) -> Html:
    """An element of a page; `class_` is its class."""
    given = "".join(f' {key.rstrip("_")}="{html.escape(value)}"' for key, value in attributes.items())
    return Html(f"<{name}{given}>{''.join(map(_escaped, content))}</{name}>")


def table(columns: Sequence[Any], rows: Iterable[Sequence[Any]], numbers: Iterable[int] = ()) -> Html:
    """A table; the columns `numbers` are aligned to the right."""
    right = set(numbers)

    def line(cell: str, cells: Sequence[Any]) -> Html:
        shown = (
            element(cell, content, **({"class_": "number"} if k in right else {}))
            for k, content in enumerate(cells)
        )
        return element("tr", *shown)

    head = element("thead", line("th", columns))
    body = element("tbody", *(line("td", row) for row in rows))
    return element("div", element("table", head, body), class_="scroll")


def picture(path: Path, text: str) -> Html:
    """A PNG file, inside the page; `text` says what it shows to who cannot see it."""
    data = base64.b64encode(path.read_bytes()).decode()
    return Html(f'<img alt="{html.escape(text)}" src="data:image/png;base64,{data}">')


def write_page(path: Path, title: str, *content: Any) -> Path:
    """Write a page with a title, whole or not at all."""
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    text = (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}<title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style></head>\n<body>{element('h1', title)}"
        f"{chr(10).join(map(_escaped, content))}</body></html>\n"
    )
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def _escaped(content: Any) -> str:
    return content if isinstance(content, Html) else html.escape(str(content))
