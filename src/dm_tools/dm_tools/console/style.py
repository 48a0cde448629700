"""Looks of the page: contrast of at least 4.5 to 1, nothing that depends on colour alone, one column on a phone."""

PRIMARY, WARNING, ERROR = "#1a5a96", "#8a4b00", "#a61b1b"

CSS = """
:root { --page: #f2f4f7; --card: #ffffff; --ink: #1f2933; --faint: #52606d; --rule: #cbd2d9; --error: #a61b1b;
  --doubt: #8a4b00; --error-page: #fdeaea; --doubt-page: #fff4e0; --focus: #1a5a96; --on-primary: #ffffff; }
html { scroll-padding: 130px 0 80px; }
body { background: var(--page); color: var(--ink); }
.nicegui-content { padding: 0 12px 26vh; gap: 12px; max-width: 1680px; margin: 0 auto; width: 100%; }
h1 { font-size: 1.25rem; line-height: 1.6rem; font-weight: 650; margin: 0; }
h2 { font-size: 1.02rem; line-height: 1.4rem; font-weight: 650; margin: 0; }
.header { position: sticky; top: 0; z-index: 20; width: 100%; background: var(--page); padding: 6px 0; height: 84px;
  overflow: hidden; display: grid; align-content: start; gap: 4px; grid-template-columns: minmax(0, 1fr); }
.line.one { flex-wrap: nowrap; overflow-x: auto; overflow-y: hidden; scrollbar-width: none; white-space: nowrap; }
.one .state { flex-wrap: nowrap; }
.header h1, .header .badge, .header .now { white-space: nowrap; flex: none; }
.header .outcome { max-height: 2.6rem; overflow-y: auto; flex: 1 1 300px; white-space: normal; }
.header .below { gap: 4px 12px; }
.header .now { font-weight: 600; }
.foot { position: fixed; left: 0; right: 0; bottom: 0; z-index: 30; padding: 0 12px; max-width: 1680px; margin: auto; }
summary { cursor: pointer; display: list-item; }
summary h2 { display: inline; }
details.card:not([open]) { gap: 0; }
.unfolded { box-sizing: border-box; display: grid; grid-template-columns: minmax(0, 1fr); gap: 8px; }
.pair > details.card:not([open]) { align-self: start; }
.state { display: flex; flex-wrap: wrap; gap: 8px; }
.line { display: flex; flex-wrap: wrap; gap: 8px; align-items: center; width: 100%; }
.badge { border: 1px solid var(--faint); border-radius: 999px; padding: 1px 10px; font-size: .85rem;
  background: var(--card); }
.badge.bad { border-color: var(--error); color: var(--error); font-weight: 600; }
.badge.doubt { border-color: var(--doubt); color: var(--doubt); font-weight: 600; }
.failures { width: 100%; max-height: 24vh; overflow-y: auto; }
.failure { background: var(--error-page); border-left: 6px solid var(--error); padding: 6px 10px;
  margin-top: 6px; width: 100%; display: flex; gap: 8px;
  align-items: flex-start; justify-content: space-between; overflow-wrap: anywhere; }
.failure .q-btn { flex: none; min-height: 28px; }
.failure.missing { background: var(--doubt-page); border-left-color: var(--doubt); }
.grid { display: grid; gap: 12px; width: 100%; grid-template-columns: minmax(330px, 4fr) minmax(0, 9fr);
  align-items: start; }
.column { display: grid; grid-template-columns: minmax(0, 1fr); gap: 12px; min-width: 0; }
.pair { display: grid; gap: 12px; grid-template-columns: repeat(2, minmax(0, 1fr)); align-items: stretch; }
.card { background: var(--card); border: 1px solid var(--rule); border-radius: 8px; padding: 12px; min-width: 0;
  display: grid; grid-template-columns: minmax(0, 1fr); gap: 8px; align-content: start; }
.panels { display: grid; gap: 12px; grid-template-columns: repeat(auto-fit, minmax(min(250px, 100%), 1fr));
  width: 100%; }
.panel { min-width: 0; }
.text { font-size: .9rem; line-height: 1.3rem; overflow-wrap: anywhere; white-space: pre-line; }
.reason { font-size: .85rem; color: var(--doubt); }
.refused { color: var(--error); font-weight: 600; }
.figures { font-variant-numeric: tabular-nums; }
.prediction { min-height: 2.6rem; }
.scroll { max-height: 340px; overflow: auto; width: 100%; font-size: .82rem; }
.scroll table { width: 100%; border-collapse: collapse; }
.scroll td { padding: 1px 8px 1px 0; vertical-align: top; overflow-wrap: anywhere; white-space: nowrap; }
.status { margin-bottom: 6px; overflow-wrap: anywhere; }
.faint { color: var(--faint); }
.scroll td:first-child { font-weight: 600; }
.scroll td:last-child { white-space: normal; width: 100%; }
.numbers th { text-align: right; font-weight: 600; padding: 1px 8px 1px 0; }
.numbers td, .numbers td:first-child, .numbers td:last-child { text-align: right; width: auto; font-weight: 400;
  font-variant-numeric: tabular-nums; }
.map:focus-visible, .scroll:focus-visible { outline: 3px solid var(--focus); outline-offset: 2px; }
button:focus-visible, .q-slider:focus-within { outline: 3px solid var(--focus); outline-offset: 2px; }
.q-btn { min-height: 40px; }
.q-btn.bg-primary { color: var(--on-primary); }
.chart { container-type: inline-size; width: 100%; }
.chart .nicegui-echart { width: 100%; height: auto; }
.chart .square { height: calc(100cqw + 44px); cursor: pointer; }
.chart .heat { height: calc(100cqw - 40px); }
.chart .bars, .chart .loop { height: 340px; }
.chart .run { height: 190px; }
.empty { color: var(--faint); padding: 24px 8px; text-align: center; }
.work { display: flex; gap: 8px; align-items: center; flex: 1 1 300px; min-width: 0; }
.work .text { flex: 0 1 auto; overflow: hidden; display: -webkit-box; -webkit-box-orient: vertical;
  -webkit-line-clamp: 2; }
@media (max-width: 1000px) {
  .header { height: 120px; padding: 4px 0; gap: 2px; }
  .header h1 { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }
  .header .below { gap: 2px 12px; }
  .header .badge { line-height: 1.2rem; }
  .badge:first-child { order: 1; }
  .badge.bad { order: -2; }
  .badge.doubt { order: -1; }
  .header .now { white-space: normal; flex: 0 1 auto; }
  .grid, .pair { grid-template-columns: minmax(0, 1fr); }
  .column { display: contents; }
}
@media (prefers-color-scheme: dark) {
  :root { --page: #12161b; --card: #1b2129; --ink: #e6eaee; --faint: #aab4bf; --rule: #3a444f; --error: #ff9a94;
    --doubt: #f0b35c; --error-page: #3a1c1e; --doubt-page: #33270f; --focus: #7fb6e8;
    --on-primary: #0d1a26; }
  body { --q-primary: #7fb6e8 !important; --q-negative: #ff9a94 !important; --q-warning: #f0b35c !important; }
  .chart svg [fill="#1f2933"] { fill: var(--ink); }
  .chart svg [stroke="#1f2933"] { stroke: var(--ink); }
  .chart svg [stroke="#c3ccd5"] { stroke: var(--rule); }
}
"""
