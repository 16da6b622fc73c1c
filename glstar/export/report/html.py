"""Building blocks of a page: one self-contained HTML file, whose text is escaped and whose only script is glstar's."""

import json
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256
from html import escape
from typing import Any

import numpy as np

from glstar.system.resources import asset

# Marks of the truth that the viewer can hide, by their class in assets/page.js.
TRUTH_SWITCHES = {"trails": "trails", "circles": "detectable stars", "names": "names"}
# Content of ``<meta name="generator">``: by it glstar recognises its own pages.
GENERATOR = "glstar"

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="generator" content="{generator}">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
{body}
<script type="application/json" id="data">{data}</script>
<script>{script}</script>
</body>
</html>
"""


def page(title: str, sections: Iterable[str], data: Mapping[str, Any]) -> bytes:
    """Return a page as UTF-8.

    `title` is text; `sections` are HTML, whose text the caller has escaped; `data` is what the script reads as JSON.
    The page's policy allows the browser no network, and no script but glstar's own.
    """
    script = asset("page.js").read_text(encoding="utf-8")
    digest = b64encode(sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    text = _PAGE.format(
        generator=GENERATOR,
        policy=policy,
        title=escape(title),
        style=asset("page.css").read_text(encoding="utf-8"),
        body=f"<h1>{escape(title)}</h1>\n" + "\n".join(sections),
        data=_for_script(data),
        script=script,
    )
    # Lone surrogates, as in file names of no encoding, have no UTF-8.
    return text.encode("utf-8", "replace")


def _for_script(data: Mapping[str, Any]) -> str:
    """Return JSON that cannot end its element, whatever text is in it."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def evenly(count: int, most: int) -> list[int]:
    """Return at most this many of the numbers from 0 to count - 1, evenly chosen, with the first and the last."""
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, most)).tolist()})


def section(title: str, *content: str, is_closed: bool = False) -> str:
    """Return a section under a heading; one that `is_closed` shows its content on a click."""
    inside = "\n".join(content)
    if is_closed:
        return f"<details><summary>{escape(title)}</summary>\n{inside}\n</details>"
    return f"<section>\n<h2>{escape(title)}</h2>\n{inside}\n</section>"


def paragraph(text: str) -> str:
    """Return a paragraph of text."""
    return f"<p>{escape(text)}</p>"


def table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of text."""
    cells = "".join(f"<th>{escape(cell)}</th>" for cell in heading)
    body = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table>\n<tr>{cells}</tr>\n{body}\n</table></div>'


def columns(kind: str, parts: Iterable[str]) -> str:
    """Return charts side by side where the screen has room; `kind`: "curves" or "maps"."""
    inside = "\n".join(parts)
    return f'<div class="{kind}">\n{inside}\n</div>'


def thumbnails(pictures: Iterable[tuple[str, bytes]]) -> str:
    """Return the images of a page, (caption, JPEG) each; the viewer shows one on a click."""
    buttons = "\n".join(
        f'<button data-k="{k}"><img alt="" src="data:image/jpeg;base64,{b64encode(jpeg).decode()}">'
        f"<span>{escape(caption)}</span></button>"
        for k, (caption, jpeg) in enumerate(pictures)
    )
    return f'<div class="thumbnails">\n{buttons}\n</div>'


def picture(title: str, png: bytes) -> str:
    """Return an image, a PNG, that fills the width."""
    return f'<img class="plot" alt="{escape(title)}" src="data:image/png;base64,{b64encode(png).decode()}">'


def viewer(switches: Mapping[str, str]) -> str:
    """Return the viewer of a frame; `switches`: label of each kind of mark that can be hidden, by its class."""
    boxes = "".join(
        f'<label><input type="checkbox" checked data-layer="{escape(kind)}"> {escape(label)}</label>'
        for kind, label in switches.items()
    )
    return (
        '<div class="viewer"><div class="controls"><button id="before" title="the frame before">&larr;</button>'
        '<button id="after" title="the next frame">&rarr;</button><button id="closer" title="zoom in">+</button>'
        '<button id="farther" title="zoom out">&minus;</button><button id="whole">whole frame</button>'
        f'{boxes}</div><svg id="stage" role="img" aria-label="the frame"></svg><p id="caption"></p></div>'
    )


def markdown(text: str) -> str:
    """Return a data card as HTML: headings, lists, tables, code and paragraphs are all that it has."""
    html: list[str] = []
    for block in text.split("\n\n"):
        lines = block.strip("\n").split("\n")
        if lines[0].startswith("# "):
            continue
        if lines[0].startswith("## "):
            html.append(f"<h3>{escape(lines[0][3:])}</h3>")
        elif lines[0].startswith("| ") and len(lines) > 1:
            cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
            html.append(table(cells[0], cells[2:]))
        elif lines[0].startswith("- "):
            html.append("<ul>" + "".join(f"<li>{_code(line[2:])}</li>" for line in lines) + "</ul>")
        elif lines[0].startswith("```"):
            html.append(f"<pre>{escape(chr(10).join(lines[1:-1]))}</pre>")
        else:
            html.append(f"<p>{_code(' '.join(lines))}</p>")
    return "\n".join(html)


def _code(text: str) -> str:
    """Return escaped text, in which every second part between backticks is code."""
    parts = [escape(part) for part in text.split("`")]
    return "".join(f"<code>{part}</code>" if k % 2 and k < len(parts) - 1 else part for k, part in enumerate(parts))
