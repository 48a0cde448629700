"""Looks of the page: contrast of at least 4.5 to 1, nothing that depends on colour alone, one column on a phone."""

PRIMARY, WARNING, ERROR = "#1a5a96", "#8a4b00", "#a61b1b"

CSS = """
body { background: #f2f4f7; color: #1f2933; }
.nicegui-content { padding: 0 12px 24px; gap: 12px; max-width: 1680px; margin: 0 auto; width: 100%; }
h1 { font-size: 1.25rem; line-height: 1.6rem; font-weight: 650; margin: 0; }
h2 { font-size: 1.02rem; line-height: 1.4rem; font-weight: 650; margin: 0; }
.header { position: sticky; top: 0; z-index: 20; width: 100%; background: #f2f4f7; padding: 8px 0; }
.state { display: flex; flex-wrap: wrap; gap: 8px; }
.line { display: flex; flex-wrap: wrap; gap: 8px; align-items: center; width: 100%; }
.badge { border: 1px solid #52606d; border-radius: 999px; padding: 1px 10px; font-size: .85rem; background: white; }
.badge.bad { border-color: #a61b1b; color: #a61b1b; font-weight: 600; }
.badge.doubt { border-color: #8a4b00; color: #8a4b00; font-weight: 600; }
.failures { width: 100%; max-height: 40vh; overflow-y: auto; }
.failure { background: #fdeaea; border-left: 6px solid #a61b1b; padding: 6px 10px; margin-top: 6px; width: 100%;
  display: flex; gap: 8px; align-items: flex-start; justify-content: space-between; overflow-wrap: anywhere; }
.failure .q-btn { flex: none; min-height: 28px; }
.failure.missing { background: #fff4e0; border-left-color: #8a4b00; }
.grid { display: grid; gap: 12px; width: 100%; grid-template-columns: minmax(330px, 4fr) minmax(0, 9fr);
  align-items: start; }
.column { display: grid; grid-template-columns: minmax(0, 1fr); gap: 12px; min-width: 0; }
.pair { display: grid; gap: 12px; grid-template-columns: repeat(2, minmax(0, 1fr)); align-items: stretch; }
.card { background: white; border: 1px solid #cbd2d9; border-radius: 8px; padding: 12px; min-width: 0;
  display: grid; grid-template-columns: minmax(0, 1fr); gap: 8px; align-content: start; }
.panels { display: grid; gap: 12px; grid-template-columns: repeat(auto-fit, minmax(min(250px, 100%), 1fr));
  width: 100%; }
.panel { min-width: 0; }
.text { font-size: .9rem; line-height: 1.3rem; overflow-wrap: anywhere; white-space: pre-line; }
.reason { font-size: .85rem; color: #8a4b00; }
.refused { color: #a61b1b; font-weight: 600; }
.figures { font-variant-numeric: tabular-nums; }
.scroll { max-height: 340px; overflow: auto; width: 100%; font-size: .82rem; }
.scroll table { width: 100%; border-collapse: collapse; }
.scroll td { padding: 1px 8px 1px 0; vertical-align: top; overflow-wrap: anywhere; }
.status { margin-bottom: 6px; overflow-wrap: anywhere; }
.faint { color: #52606d; }
.scroll td { white-space: nowrap; }
.scroll td:first-child { font-weight: 600; }
.scroll td:last-child { white-space: normal; width: 100%; }
.numbers th { text-align: right; font-weight: 600; padding: 1px 8px 1px 0; }
.numbers td, .numbers td:first-child, .numbers td:last-child { text-align: right; width: auto; font-weight: 400;
  font-variant-numeric: tabular-nums; }
.map:focus-visible, .scroll:focus-visible { outline: 3px solid #1a5a96; outline-offset: 2px; }
button:focus-visible, .q-slider:focus-within { outline: 3px solid #1a5a96; outline-offset: 2px; }
.q-btn { min-height: 40px; }
.chart { container-type: inline-size; width: 100%; }
.chart .nicegui-echart { width: 100%; height: auto; }
.chart .square { height: calc(100cqw + 44px); cursor: pointer; }
.chart .heat { height: calc(100cqw - 40px); }
.chart .bars { height: 340px; }
.chart .run { height: 190px; }
.chart .loop { height: 340px; }
.empty { color: #52606d; padding: 24px 8px; text-align: center; }
@media (max-width: 1000px) {
  .grid, .pair { grid-template-columns: minmax(0, 1fr); }
  .column { display: contents; }
}
@media (max-width: 760px) {
  .failures { max-height: 30vh; }
}
"""
