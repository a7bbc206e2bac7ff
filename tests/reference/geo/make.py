"""Reference values between geodetic and local coordinates, by two independent programs: GeographicLib's CartConvert (Debian package
geographiclib-tools) and pymap3d (PyPI). Prints JSON lines; fails where the two differ by a micrometre.

    python make.py > local.ndjson
    python make.py ground > ground.ndjson    # from places on the plane z = 0 to geodetic coordinates
"""

import json
import random
import subprocess
import sys

import pymap3d

random.seed(23)
ORIGINS = [(48.137, 11.575, 520.0), (-33.9, 151.2, 30.0), (0.0, 0.0, 0.0), (78.2, 15.6, 400.0), (-0.5, -179.9, 2800.0)]


def cart_convert(origin, values, *options):
    command = ["CartConvert", "-l", *(str(v) for v in origin), "-p", "8", *options]
    line = subprocess.run(command, input=" ".join(f"{v:.9f}" for v in values), capture_output=True, text=True, check=True)
    return [float(v) for v in line.stdout.split()]


def local():
    for lat0, lon0, h0 in ORIGINS:
        for reach_deg in [0.001, 0.05, 0.9]:
            for _ in range(4):
                lat = lat0 + random.uniform(-reach_deg, reach_deg)
                lon = lon0 + random.uniform(-reach_deg, reach_deg)
                lon = (lon + 180.0) % 360.0 - 180.0
                h = h0 + random.uniform(-500.0, 3000.0)
                place = [round(lat, 9), round(lon, 9), round(h, 3)]
                found = cart_convert((lat0, lon0, h0), place)
                other = pymap3d.geodetic2enu(*place, lat0, lon0, h0)
                assert max(abs(a - b) for a, b in zip(found, other)) < 1e-6, (place, found, other)
                print(json.dumps({"origin": [lat0, lon0, h0], "place": place, "local_m": found}))


def ground():
    for origin in ORIGINS:
        for _ in range(3):
            local_m = [round(random.uniform(-110.0, 110.0), 3), round(random.uniform(-110.0, 110.0), 3), 0.0]
            found = cart_convert(origin, local_m, "-r")
            other = pymap3d.enu2geodetic(*local_m, *origin)
            off = pymap3d.geodetic2enu(*found, *other)
            assert max(abs(v) for v in off) < 1e-6, (local_m, found, other)
            print(json.dumps({"origin": origin, "local_m": local_m, "place": found}))


ground() if sys.argv[1:] == ["ground"] else local()
