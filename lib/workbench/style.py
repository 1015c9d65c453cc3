"""The look of the report: one sheet for the pages of notebooks, one more for the index."""

PAGE_CSS = """
:root { --ink: #1d2733; --dim: #64748b; --line: #e3e8ee; --ground: #ffffff; --soft: #f6f8fa; --accent: #0072b2;
  --paper: #b34a00; --bad: #b42318; --good: #067647; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: var(--ground);
  font: 16px/1.6 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif; }
a { color: var(--accent); text-decoration: none; } a:hover { text-decoration: underline; }
nav { display: flex; gap: 2em; justify-content: space-between; padding: .6em 1.5em; border-bottom: 1px solid var(--line);
  font-size: 14px; background: var(--soft); }
nav .home { font-weight: 700; color: var(--ink); }
nav.foot { border-top: 1px solid var(--line); border-bottom: 0; margin-top: 3em; }
main { max-width: 1080px; margin: 0 auto; padding: 1em 1.5em 2em; }
h1 { font-size: 2em; line-height: 1.2; margin: .8em 0 .5em; } h2 { font-size: 1.35em; margin: 1.8em 0 .5em; }
h3 { font-size: 1.1em; margin: 1.4em 0 .4em; }
.prose { max-width: 48em; } .prose p { margin: .7em 0; }
.prose svg, .equation svg { max-width: 100%; } .equation { margin: 1em 0; text-align: center; overflow-x: auto; }
img { max-width: 100%; height: auto; display: block; margin: .6em 0 .3em; }
table { border-collapse: collapse; margin: .8em 0; font-size: 15px; }
th, td { padding: .35em .8em; border-bottom: 1px solid var(--line); text-align: left; vertical-align: baseline; }
th { color: var(--dim); font-weight: 600; border-bottom: 2px solid var(--line); }
pre { font: 13px/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace; overflow-x: auto;
  margin: .4em 0; white-space: pre-wrap; }
code { font: .88em ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace; }
.code { background: var(--soft); border-left: 3px solid var(--line); padding: .1em .9em; margin: 1.2em 0 .4em; }
.code pre { margin: .5em 0; }
.given { font-size: 13px; color: var(--dim); }
.output { padding-left: .9em; } .stderr { color: var(--dim); }
.error { background: #fef3f2; border-left: 3px solid var(--bad); padding: .7em 1em; }
.interactive > p { font-size: 13px; color: var(--dim); margin: 0; }
.plotly-view { height: 560px; }
blockquote { margin: 1em 0; padding: .1em 1em; border-left: 3px solid var(--accent); background: var(--soft); }
.tex { color: var(--bad); }
@media print { nav { display: none; } main { max-width: none; } }
"""

INDEX_CSS = """
main { max-width: 1200px; }
header { padding: 2.2em 0 .6em; } header h1 { margin: 0; font-size: 2.3em; }
header p { margin: .3em 0; color: var(--dim); max-width: 52em; }
.badge { display: inline-block; border-radius: 1em; padding: .1em .8em; font-size: 13px; font-weight: 600; color: #fff;
  vertical-align: middle; margin-left: .6em; background: var(--dim); }
.badge.complete { background: var(--good); } .badge.failed, .badge.stopped { background: var(--bad); }
.badge.running { background: #b54708; }
.facts { display: flex; flex-wrap: wrap; gap: .4em 2.2em; padding: .8em 0 0; font-size: 14px; }
.facts b { display: block; font-size: 12px; color: var(--dim); font-weight: 600; }
.table { overflow-x: auto; } .table table { width: 100%; }
td.number { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; } th.number { text-align: right; }
td.ours { font-weight: 700; color: var(--accent); } td.paper { color: var(--paper); }
td.note, .dim { color: var(--dim); font-size: 14px; }
td small { display: block; color: var(--dim); }
.steps { display: grid; grid-template-columns: repeat(auto-fill, minmax(340px, 1fr)); gap: 1.2em; margin: 1em 0; }
.step { border: 1px solid var(--line); border-radius: 10px; overflow: hidden; display: flex; flex-direction: column; }
.step .picture { height: 210px; background: var(--soft); display: flex; align-items: center; justify-content: center; }
.step .picture img { max-height: 210px; max-width: 100%; margin: 0; object-fit: contain; }
.step .text { padding: .7em 1em .9em; } .step h3 { margin: 0 0 .2em; } .step p { margin: .2em 0; font-size: 14px; }
.step.failed { border-color: var(--bad); } .step .why { color: var(--bad); }
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(480px, 1fr)); gap: 1.6em; }
figure { margin: 0; } figure img { border: 1px solid var(--line); border-radius: 6px; width: 100%; background: #fff; }
figcaption { font-size: 14px; color: var(--dim); }
details { margin: .5em 0; } summary { cursor: pointer; font-weight: 600; }
@media (max-width: 620px) { .gallery { grid-template-columns: 1fr; } }
"""
