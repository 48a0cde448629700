"""Make camera.gif of the README: the animation that `./dm demo --camera` leaves in runs/demo, with fewer colours.

./dm exec python docs/images/camera.py
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image, ImageSequence

#: The image that a search ends with is shown by the demo for longer than this.
MOMENT_MS = 200
#: How long each is shown here.
SEARCH_MS, END_MS = 150, 2000
COLOURS = 128


def main() -> None:
    source = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo/camera.gif")
    kept: list[tuple[Image.Image, int]] = []
    with Image.open(source) as animation:
        for frame in ImageSequence.Iterator(animation):
            ends = frame.info["duration"] > MOMENT_MS
            kept.append((frame.convert("RGB"), END_MS if ends else SEARCH_MS))
    # One palette for all: that of the first frame, where all is dull, beside those that the searches end with.
    shown = [kept[0][0], *(frame for frame, duration in kept if duration == END_MS)]
    sheet = Image.new("RGB", (shown[0].width, shown[0].height * len(shown)))
    for number, frame in enumerate(shown):
        sheet.paste(frame, (0, number * frame.height))
    palette = sheet.quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame, _duration in kept)
    target = Path(__file__).with_suffix(".gif")
    durations = [duration for _frame, duration in kept]
    first.save(target, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)
    print(f"{target}: {len(kept)} frames, {target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
