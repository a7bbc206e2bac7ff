"""Opens GeoJSON as an analyst would; a warning is an error. Usage: geojson.py ADDRESS"""

import sys
import warnings

import geopandas
import shapely

warnings.simplefilter("error")
address = sys.argv[1]
read = {name: geopandas.read_file(f"{address}/v1/{name}.geojson") for name in ["positions", "alerts", "footprint"]}
for name, frame in read.items():
    # WGS 84, with heights or without.
    assert frame.crs.to_epsg() in (4326, 4979), (name, frame.crs)
    assert frame.geometry.is_valid.all(), (name, frame.geometry)
positions, alerts, footprint = (read[name] for name in ["positions", "alerts", "footprint"])
[outline] = footprint.geometry
assert outline.exterior.is_ccw
# The built-in scene is 300 m high and 250 m across, about its origin.
area = footprint.to_crs(footprint.estimate_utm_crs()).geometry.area.iloc[0]
assert 0.9 < area / 250**2 < 1.1, area
assert len(positions) > 0 and positions.geometry.geom_type.eq("Point").all(), positions
assert positions.geometry.within(outline).all(), positions
assert outline.contains(shapely.Point(11.575, 48.137))
assert alerts["kind"].isin(["unclaimed_emitter"]).any(), alerts
