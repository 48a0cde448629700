"""Make licence.svg, the badge of the README, which so fetches nothing from elsewhere.

./dm exec python docs/images/licence.py
"""

from __future__ import annotations

from pathlib import Path

NAME, LICENCE = "licence", "Apache-2.0"
#: px: height, where the two parts meet, and the whole width.
HEIGHT, MIDDLE, WIDTH = 20, 52, 122


def main() -> None:
    Path(__file__).with_suffix(".svg").write_text(f"""\
<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" role="img" aria-label="{NAME}: {LICENCE}">
  <title>{NAME}: {LICENCE}</title>
  <rect width="{WIDTH}" height="{HEIGHT}" rx="3" fill="#555"/>
  <path d="M{MIDDLE} 0h{WIDTH - MIDDLE - 3}a3 3 0 0 1 3 3v14a3 3 0 0 1-3 3H{MIDDLE}z" fill="#0072b2"/>
  <g fill="#fff" text-anchor="middle" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">
    <text x="{MIDDLE // 2}" y="14">{NAME}</text>
    <text x="{(MIDDLE + WIDTH) // 2}" y="14">{LICENCE}</text>
  </g>
</svg>
""")


if __name__ == "__main__":
    main()
