"""Reference values of geodetic to local coordinates, by two independent programs: GeographicLib's CartConvert (Debian package
geographiclib-tools) and pymap3d (PyPI). Prints JSON lines; fails where the two differ by a micrometre.

    python make.py > local.ndjson
"""

import json
import random
import subprocess

import pymap3d

random.seed(23)
ORIGINS = [(48.137, 11.575, 520.0), (-33.9, 151.2, 30.0), (0.0, 0.0, 0.0), (78.2, 15.6, 400.0), (-0.5, -179.9, 2800.0)]
for lat0, lon0, h0 in ORIGINS:
    for reach_deg in [0.001, 0.05, 0.9]:
        for _ in range(4):
            lat = lat0 + random.uniform(-reach_deg, reach_deg)
            lon = lon0 + random.uniform(-reach_deg, reach_deg)
            lon = (lon + 180.0) % 360.0 - 180.0
            h = h0 + random.uniform(-500.0, 3000.0)
            place = [round(lat, 9), round(lon, 9), round(h, 3)]
            command = ["CartConvert", "-l", str(lat0), str(lon0), str(h0), "-p", "8"]
            line = subprocess.run(command, input=" ".join(f"{v:.9f}" for v in place), capture_output=True, text=True, check=True)
            local = [float(v) for v in line.stdout.split()]
            other = pymap3d.geodetic2enu(*place, lat0, lon0, h0)
            assert max(abs(a - b) for a, b in zip(local, other)) < 1e-6, (place, local, other)
            print(json.dumps({"origin": [lat0, lon0, h0], "place": place, "local_m": local}))
