//! Terrain: files written here, and rays over it.

use std::io::Cursor;
use std::sync::Arc;
use std::time::Instant;

use jiff::Timestamp;
use nalgebra::{Matrix6, UnitQuaternion, Vector2, Vector6};
use oapwatch::geo::{Datum, Geodetic, LocalAxes, Origin, Sight, Terrain, View};
use oapwatch::optics;
use oapwatch::pose::{Mount, Pose};

use super::tiff::{self, Field, Kind};

const ORIGIN: Origin = Origin {
    latitude_deg: 48.137,
    longitude_deg: 11.575,
    height_m: 500.0,
    datum: Datum::Msl,
};
const GEOGRAPHIC: &[(u16, u16)] = &[(1024, 2), (1025, 1), (2048, 4326)];

fn read(bytes: Vec<u8>, name: &str, origin: &Origin) -> Result<Terrain, String> {
    Terrain::read(Cursor::new(bytes), name, origin).map_err(|e| e.to_string())
}

/// A model of 60 × 50 pixels of about 90 m about the origin, by latitude and longitude; `corner` says what its keys do.
fn degrees(kind: Kind, is_tiled: bool, keys: &[(u16, u16)], more: &[Field], z: impl Fn(f64, f64) -> f64) -> Vec<u8> {
    let (west, north, pixel) = (11.575 - 0.036, 48.137 + 0.02, [0.0012, 0.0008]);
    let mut fields = tiff::place(west, north, pixel).to_vec();
    fields.push(tiff::keys(keys));
    fields.extend_from_slice(more);
    tiff::image([60, 50], kind, is_tiled, &fields, |x, y| {
        let [dx, dy] = [x, y].map(|k| k as f64 + 0.5);
        z(west + pixel[0] * dx, north - pixel[1] * dy)
    })
}

/// A height of the ellipsoid's own shape plus a slope: what it is in local axes, the caller works out.
fn slope(longitude_deg: f64, latitude_deg: f64) -> f64 {
    520.0 + 2000.0 * (longitude_deg - 11.575) - 1500.0 * (latitude_deg - 48.137)
}

/// The place on the earth of local east and north where the ground has the height that `z` gives, and its local height.
fn on_ground(x: f64, y: f64, z: impl Fn(f64, f64) -> f64) -> f64 {
    let axes = LocalAxes::at(ORIGIN.geodetic());
    let mut up = 0.0;
    for _ in 0..20 {
        let place = axes.to_geodetic([x, y, up]);
        up += z(place.longitude_deg, place.latitude_deg) - place.height_m;
    }
    up
}

#[test]
fn a_geotiff_by_latitude_and_longitude_is_read_whatever_its_layout() {
    for (kind, rounding_m) in [(Kind::F32, 0.01), (Kind::F64, 0.01), (Kind::I16, 1.1), (Kind::U16, 1.1)] {
        for is_tiled in [false, true] {
            let file = degrees(kind, is_tiled, GEOGRAPHIC, &[], slope);
            let terrain = read(file, "dem.tif", &ORIGIN).unwrap();
            for [x, y] in [[0.0, 0.0], [812.0, -333.0], [-2400.0, 1300.0], [2400.0, -1800.0]] {
                let found = terrain.at([x, y]).expect("covered").z_m;
                let expected = on_ground(x, y, slope);
                assert!((found - expected).abs() < rounding_m, "{x} {y}: {found} {expected}");
            }
            assert!(terrain.at([0.0, 3000.0]).is_none() && terrain.voids().is_some());
        }
    }
}

#[test]
fn pixels_are_areas_or_points_and_a_transformation_says_where_too() {
    // As a point the same corner is that pixel's centre: half a pixel to the north-west.
    let as_points = degrees(
        Kind::F64,
        false,
        &[(1024, 2), (1025, 2), (2048, 4326)],
        &[],
        |lon, lat| slope(lon - 0.0006, lat + 0.0004),
    );
    let transformation = [
        0.0012,
        0.0,
        0.0,
        11.575 - 0.036,
        0.0,
        -0.0008,
        0.0,
        48.137 + 0.02,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        1.0,
    ];
    let fields = [tiff::doubles(34264, &transformation), tiff::keys(GEOGRAPHIC)];
    let transformed = tiff::image([60, 50], Kind::F64, false, &fields, |x, y| {
        slope(
            11.575 - 0.036 + 0.0012 * (x as f64 + 0.5),
            48.137 + 0.02 - 0.0008 * (y as f64 + 0.5),
        )
    });
    for file in [as_points, transformed] {
        let terrain = read(file, "dem.tiff", &ORIGIN).unwrap();
        let found = terrain.at([500.0, 300.0]).expect("covered").z_m;
        assert!((found - on_ground(500.0, 300.0, slope)).abs() < 0.01);
    }
}

#[test]
fn utm_agrees_with_proj() {
    // pyproj 3: Transformer.from_crs(4326, code, always_xy=True).
    for (latitude_deg, longitude_deg, code, [east, north]) in [
        (48.137, 11.575, 32632, [691567.32638_f64, 5334734.33048_f64]),
        (-33.9, 18.4, 32734, [259583.22166, 6245888.04544]),
        (61.2, -149.9, 32606, [344173.86411, 6788521.41816]),
        (48.137, 11.575, 32633, [245204.03790, 5337202.21333]),
        (0.5, 179.99, 32601, [164919.84849, 55341.89867]),
    ] {
        let origin = Origin {
            latitude_deg,
            longitude_deg,
            height_m: 0.0,
            datum: Datum::Msl,
        };
        // Heights that are the map coordinates: at the origin they must be those of the reference.
        for axis in [0, 1] {
            let (west, top) = (east.floor() - 320.0, north.floor() + 320.0);
            let mut fields = tiff::place(west, top, [10.0, 10.0]).to_vec();
            fields.push(tiff::keys(&[(1024, 1), (1025, 1), (3072, code), (3076, 9001)]));
            let file = tiff::image([64, 64], Kind::F64, true, &fields, |x, y| match axis {
                0 => west + 10.0 * (x as f64 + 0.5) - east,
                _ => top - 10.0 * (y as f64 + 0.5) - north,
            });
            let ground = read(file, "utm.tif", &origin).unwrap().at([0.0, 0.0]).expect("covered");
            assert!(ground.z_m.abs() < 1e-4, "{code} {axis}: {ground:?}");
        }
    }
}

#[test]
fn an_srtm_tile_lies_where_its_name_says_and_has_voids() {
    let side = 1201;
    let value = |x: usize, y: usize| match (x, y) {
        (700, 1030) => i16::MIN,
        _ => 400 + (x as i16 - 600) / 4,
    };
    let bytes: Vec<u8> = (0..side * side)
        .flat_map(|k| value(k % side, k / side).to_be_bytes())
        .collect();
    let terrain = read(bytes.clone(), "N48E011.hgt", &ORIGIN).unwrap();
    // 0.575° are 690 steps of 3″ from the west.
    let found = terrain.at([0.0, 0.0]).expect("covered").z_m;
    assert!((found + 500.0 - 422.0).abs() < 1.0, "{found}");
    // The void: 48 + 170/1200 degrees north, 11 + 700/1200 east.
    let [x, y, _] = LocalAxes::at(ORIGIN.geodetic()).to_local(Geodetic {
        latitude_deg: 49.0 - 1030.0 / 1200.0,
        longitude_deg: 11.0 + 700.0 / 1200.0,
        height_m: 400.0,
    });
    assert!(terrain.at([x, y]).is_none() && terrain.at([x + 400.0, y]).is_some());
    let (share, nearest_m) = terrain.voids().expect("one, and what is south of the tile");
    assert!(
        share > 0.1 && (nearest_m - x.hypot(y)).abs() < 150.0,
        "{share} {nearest_m}"
    );
    assert!(terrain.warnings().iter().any(|w| w.contains("voids")) && terrain.half_m() >= 20_000.0);

    let refused = |bytes: &[u8], name: &str| read(bytes.to_vec(), name, &ORIGIN).unwrap_err();
    assert!(refused(&bytes, "munich.hgt").contains("N48E011.hgt"));
    assert!(refused(&bytes[2..], "N48E011.hgt").contains("2884800 bytes"));
    assert!(refused(&bytes, "N47E011.hgt").contains("does not reach there"));
    assert!(refused(&bytes, "N48E011.asc").contains(".tif, .tiff or .hgt"));
    let above_ellipsoid = Origin {
        datum: Datum::Ellipsoid,
        ..ORIGIN
    };
    // The same ground from an origin whose height is above the ellipsoid: EGM96 lies 45.5 m above it there.
    let converted = read(bytes, "N48E011.hgt", &above_ellipsoid).unwrap();
    let raised = converted.at([0.0, 0.0]).expect("ground").z_m - terrain.at([0.0, 0.0]).expect("ground").z_m;
    assert!((raised - 45.5).abs() < 0.5, "{raised}");
}

#[test]
fn what_cannot_be_taken_for_heights_is_refused_with_the_reason() {
    let refused = |keys: &[(u16, u16)], more: &[Field]| {
        read(degrees(Kind::F32, false, keys, more, slope), "dem.tif", &ORIGIN).unwrap_err()
    };
    for (keys, more, expected) in [
        (&[(1024, 2), (2048, 4258)][..], &[][..], "found EPSG:4258"),
        (&[(1024, 1), (3072, 3857)], &[], "found EPSG:3857"),
        (&[(1024, 1), (3072, 32767)], &[], "user-defined"),
        (&[], &[], "a file that names none"),
        (&[(1024, 2), (2048, 4326), (2054, 9105)], &[], "EPSG:9105"),
        (
            &[(1024, 2), (2048, 4326), (4099, 9002)],
            &[],
            "heights in metres (EPSG:9001), found units EPSG:9002",
        ),
        (GEOGRAPHIC, &[tiff::text(42113, "none")], "GDAL_NODATA"),
        (
            GEOGRAPHIC,
            &[tiff::text(
                42112,
                "<Item name=\"SCALE\" sample=\"0\" role=\"scale\">0.1</Item>",
            )],
            "a scale",
        ),
    ] {
        let error = refused(keys, more);
        assert!(error.contains(expected), "{error}");
    }
    let ellipsoid = Origin {
        datum: Datum::Ellipsoid,
        ..ORIGIN
    };
    let stated = degrees(Kind::F32, false, &[(1024, 2), (2048, 4979)], &[], slope);
    assert!(read(stated, "dem.tif", &ellipsoid).is_ok());
    let unplaced = tiff::image([8, 8], Kind::F32, false, &[tiff::keys(GEOGRAPHIC)], |_, _| 0.0);
    assert!(
        read(unplaced, "dem.tif", &ORIGIN)
            .unwrap_err()
            .contains("ModelPixelScale")
    );
    assert!(
        read(b"no TIFF".to_vec(), "dem.tif", &ORIGIN)
            .unwrap_err()
            .contains("GeoTIFF")
    );
    let void = degrees(Kind::F32, false, GEOGRAPHIC, &[tiff::text(42113, "-9999")], |_, _| {
        -9999.0
    });
    assert!(read(void, "dem.tif", &ORIGIN).unwrap_err().contains("voids only"));
    let mut cut = degrees(Kind::F32, true, GEOGRAPHIC, &[], slope);
    cut.truncate(cut.len() / 2);
    assert!(read(cut, "dem.tif", &ORIGIN).is_err());
}

#[test]
fn declared_and_undeclared_voids_have_no_height() {
    for (declared, void) in [
        (Some("7"), 7.0),
        (None, f64::from(f32::MAX)),
        (None, f64::NAN),
        (None, -9999.0),
    ] {
        let more: Vec<_> = declared.map(|text| tiff::text(42113, text)).into_iter().collect();
        let file = degrees(Kind::F32, false, GEOGRAPHIC, &more, |lon, lat| match lon > 11.58 {
            true => void,
            false => slope(lon, lat),
        });
        let terrain = read(file, "dem.tif", &ORIGIN).unwrap();
        assert!(terrain.at([0.0, 0.0]).is_some() && terrain.at([600.0, 0.0]).is_none());
    }
}

fn camera() -> optics::Camera {
    optics::Config::default().camera().unwrap()
}

fn tilted() -> Pose {
    Pose {
        attitude: UnitQuaternion::from_euler_angles(0.12, -0.2, 2.1),
        cov: Matrix6::from_diagonal(&Vector6::new(1e-5, 1e-5, 1e-3, 2.0, 2.0, 4.0)),
        ..Pose::level(Timestamp::UNIX_EPOCH, [40.0, -25.0, 280.0])
    }
}

fn over(pose: &Pose, terrain: &Arc<Terrain>) -> Sight {
    Sight::new(pose, &Mount::default()).over(Some(terrain.clone()))
}

#[test]
fn jacobians_on_slopes_are_those_of_finite_differences() {
    // The hill's cells are 40 m wide: differences of a millimetre stay in one.
    let plane = Terrain::sampled(100, 8.0, |x, y| 0.25 * x - 0.125 * y + 16.0);
    let hill = Terrain::sampled(20, 40.0, |x, y| 60.0 * (-(x * x + y * y) / 9000.0).exp());
    let (camera, pose) = (camera(), tilted());
    for terrain in [plane, hill].map(Arc::new) {
        let sight = over(&pose, &terrain);
        for sensor in [[0.0, 0.0], [0.011, -0.007], [-0.014, 0.013], [0.003, 0.009]] {
            let point = sight.ground(&camera, sensor).expect("looks down");
            let ground = terrain.at(point.horizontal_m().into()).expect("on the map");
            assert!((point.position_m.z - ground.z_m).abs() < 1e-6);
            let back = sight.sensor(&camera, point.position_m.into()).expect("in front");
            assert!((back[0] - sensor[0]).hypot(back[1] - sensor[1]) < 1e-12);
            let near = |found: Vector2<f64>, expected: Vector2<f64>| {
                assert!(
                    (found - expected).norm() < 1e-5 * (1.0 + found.norm()),
                    "{found} {expected}"
                );
            };
            for k in 0..2 {
                let h = 1e-7;
                let at = |s: f64| {
                    let moved = std::array::from_fn(|i| sensor[i] + if i == k { s } else { 0.0 });
                    sight.ground(&camera, moved).expect("looks down").horizontal_m()
                };
                near((at(h) - at(-h)) / (2.0 * h), point.by_sensor.column(k).into());
            }
            for k in 0..6 {
                let h = 1e-5;
                let at = |s: f64| {
                    let mut by = Vector6::zeros();
                    by[k] = s;
                    let moved = sight.corrected(&by, Matrix6::zeros());
                    moved.ground(&camera, sensor).expect("looks down").horizontal_m()
                };
                near((at(h) - at(-h)) / (2.0 * h), point.by_pose.column(k).into());
            }
            let there = sight.ground_at(point.horizontal_m().into()).expect("seen");
            assert!((there.by_pose - point.by_pose).norm() < 1e-5 * point.by_pose.norm());
        }
    }
}

#[test]
fn level_terrain_at_z_0_is_the_plane() {
    let flat = Arc::new(Terrain::sampled(100, 10.0, |_, _| 0.0));
    let (camera, pose) = (camera(), tilted());
    let plane = Sight::new(&pose, &Mount::default());
    for sensor in [[0.0, 0.0], [0.011, -0.007], [-0.014, 0.013]] {
        let (a, b) = (
            plane.ground(&camera, sensor).unwrap(),
            over(&pose, &flat).ground(&camera, sensor).unwrap(),
        );
        assert!((a.position_m - b.position_m).norm() < 1e-9);
        assert!((a.by_pose - b.by_pose).norm() < 1e-9 * a.by_pose.norm());
        assert!((a.by_sensor - b.by_sensor).norm() < 1e-9 * a.by_sensor.norm());
    }
}

#[test]
fn a_place_is_on_the_ground_unless_it_says_how_high_it_is() {
    let terrain = Arc::new(Terrain::sampled(100, 10.0, |x, _| 0.25 * x));
    let pose = Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, 300.0]);
    let view = View {
        camera: camera(),
        sight: Some(over(&pose, &terrain)),
    };
    assert_eq!(view.apparent(80.0, 10.0, None), Vector2::new(80.0, 10.0));
    assert_eq!(view.ground_z_m(Vector2::new(80.0, 10.0)), Some(20.0));
    // From z = 20, where the ground is: the place itself. From z = 0, 20 m below the ground: the ray meets it before.
    assert!((view.apparent(80.0, 10.0, Some(20.0)) - Vector2::new(80.0, 10.0)).norm() < 1e-9);
    // (80, 10)·t with 300 (1 − t) = 0.25·80·t.
    let t = 300.0 / 320.0;
    assert!((view.apparent(80.0, 10.0, Some(0.0)) - Vector2::new(80.0, 10.0) * t).norm() < 1e-9);
    let [x, _] = view.to_sensor([80.0, 10.0]);
    assert!((x - 80.0 / 280.0 * view.camera.plane_distance_m).abs() < 1e-12);
    let placed = view
        .place([x, 0.0], [0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])
        .expect("on the map");
    assert!((placed.position_m.x - 80.0).abs() < 1e-9 && (placed.z_m - 20.0).abs() < 1e-9);
    // Over a hilltop of 200 m the lens is lower.
    let raised = Arc::new(Terrain::sampled(100, 10.0, |_, _| 200.0));
    assert!((over(&pose, &raised).height_m() - 100.0).abs() < 1e-9);
    // What is not known is not seen.
    assert_eq!(view.to_sensor([1001.0, 0.0]), [f64::INFINITY; 2]);
    assert_eq!(view.ground_z_m(Vector2::new(1001.0, 0.0)), None);
}

/// `cargo test --release --test geo cost -- --nocapture` prints what a ray costs.
#[test]
fn cost_of_a_ray() {
    let hills = |x: f64, y: f64| 40.0 * (x / 170.0).sin() * (y / 130.0).cos();
    let camera = camera();
    let time = |sight: &Sight| {
        let began = Instant::now();
        let mut met = 0;
        for k in 0..100_000 {
            let sensor = [f64::from(k % 317) / 317.0 - 0.5, f64::from(k % 211) / 211.0 - 0.5].map(|s| s * 0.03);
            met += u32::from(sight.ground(&camera, sensor).is_some());
        }
        println!(
            "  {:.0} ns a ray, {met} of 100000 met",
            began.elapsed().as_nanos() as f64 / 1e5
        );
        met
    };
    let pose = tilted();
    println!("plane");
    time(&Sight::new(&pose, &Mount::default()));
    for spacing_m in [1.0, 5.0, 30.0] {
        let half = ((20_000.0 / spacing_m) as usize).min(2048);
        let terrain = Arc::new(Terrain::sampled(half, spacing_m, hills));
        println!("{spacing_m} m");
        assert!(time(&over(&pose, &terrain)) > 99_000);
    }
}
