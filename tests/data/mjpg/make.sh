#!/usr/bin/env bash
# Makes colours.jpg and colours.luma beside it. Needs libjpeg-turbo-progs and python3.
set -euo pipefail
cd "$(dirname "$0")"
python3 - > colours.ppm << 'PYTHON'
import math, sys
w, h = 40, 24
pixels = bytearray()
for y in range(h):
    for x in range(w):
        green = 200 * math.exp(-((x - 13.3) ** 2 + (y - 9.7) ** 2) / 18)
        red = 60 * math.exp(-((x - 30) ** 2 + (y - 15) ** 2) / 40)
        pixels += bytes(int(min(255, v)) for v in (20 + green + 2 * red, 20 + green, 30 + 0.6 * green))
sys.stdout.buffer.write(b"P6 %d %d 255\n" % (w, h) + pixels)
PYTHON
cjpeg -quality 90 -sample 2x1 -outfile colours.jpg colours.ppm
djpeg -grayscale -pnm colours.jpg | tail -c $((40 * 24)) > colours.luma
rm colours.ppm
