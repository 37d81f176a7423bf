"""The frame of the report's page: head, style, and a policy that forbids every connection."""

from __future__ import annotations

import html

# plotly compiles the functions that draw 3D at run time, hence unsafe-eval; nothing can be fetched or sent.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:; worker-src blob:; font-src data:; base-uri 'none'; form-action 'none'"
)

STYLE = """
:root { color-scheme: light; --ink: #1f2933; --soft: #52606d; --line: #e4e7eb; --tint: #f5f7fa; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 24px 64px; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 0 0 10px; overflow-wrap: anywhere; }
h3 { font-size: 1rem; margin: 20px 0 6px; overflow-wrap: anywhere; }
section { border-top: 1px solid var(--line); padding-top: 20px; margin-top: 28px; }
p { margin: 0 0 8px; max-width: 75ch; overflow-wrap: anywhere; }
.note { background: #fff8e6; border-left: 3px solid #e69f00; padding: 6px 10px; }
.scroll { overflow-x: auto; }
.panels { min-width: 680px; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { padding: 5px 12px; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { background: var(--tint); font-weight: 600; color: var(--soft); }
th.text, td.text { text-align: left; }
td.name { text-align: left; white-space: normal; min-width: 12ch; max-width: 32ch; overflow-wrap: anywhere; }
.reasons td.name:nth-child(2) { min-width: 9ch; }
.reasons td.name:nth-child(3) { min-width: 26ch; max-width: 48ch; }
tr.first td { border-top: 2px solid #cbd2d9; }
.better { color: #00664b; font-weight: 600; }
.worse { color: #a13d00; font-weight: 600; }
.open { color: var(--soft); }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 16px; margin: 0; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; }
code { font: 0.9em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
select { font: inherit; padding: 4px 8px; border: 1px solid #9aa5b1; border-radius: 4px; background: #fff;
  max-width: 100%; }
@media (max-width: 600px) {
  main { padding: 18px 14px 48px; }
  h1 { font-size: 1.35rem; }
  th, td { padding: 4px 8px; }
  dl { grid-template-columns: 1fr; gap: 0; }
  #view-scene { height: 380px !important; }
  dd { margin-bottom: 8px; }
}
@media print { section { break-inside: avoid; } }
"""


def page(title: str, body: str, script: str) -> str:
    """A whole page. `body` and `script` are trusted markup; the title is escaped here."""
    name = html.escape(title)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{name}</title>\n<style>{STYLE}</style>\n<script>{script}</script>\n</head>\n"
        f"<body>\n<main>\n<h1>{name}</h1>\n{body}\n</main>\n</body>\n</html>\n"
    )
