//! Where rays meet terrain.

use nalgebra::Vector3;
use oapwatch::geo::Terrain;

fn cross(terrain: &Terrain, from: [f64; 3], ray: [f64; 3]) -> Option<Vector3<f64>> {
    let (from, ray) = (Vector3::from(from), Vector3::from(ray));
    let found = terrain.cross(&from, &ray)?;
    let place = from + ray * found.reach;
    assert!((place.z - found.ground.z_m).abs() < 1e-6, "{place} {found:?}");
    Some(place)
}

fn hill(x: f64, y: f64) -> f64 {
    80.0 * (-((x - 100.0).powi(2) + y * y) / 5000.0).exp() - 20.0
}

#[test]
fn on_a_plane_the_crossing_is_the_exact_one() {
    // Slopes and nodes that f32 holds exactly.
    let plane = Terrain::sampled(100, 8.0, |x, y| 0.25 * x - 0.125 * y + 16.0);
    for ray in [
        [0.1, 0.2, -1.0],
        [-0.7, 0.4, -1.0],
        [0.0, 0.0, -2.0],
        [0.9, 0.0, 0.05],
        [0.0, -0.3, -0.5],
    ] {
        let from = [12.5, -31.0, 290.0];
        // n·(from + t·ray) = 16 with n = (−1/4, 1/8, 1).
        let n = Vector3::new(-0.25, 0.125, 1.0);
        let t = (16.0 - n.dot(&Vector3::from(from))) / n.dot(&Vector3::from(ray));
        let expected = Vector3::from(from) + Vector3::from(ray) * t;
        let found = cross(&plane, from, ray);
        match expected.x.abs().max(expected.y.abs()) < 800.0 && t > 0.0 {
            true => assert!(
                (found.expect("on the map") - expected).norm() < 1e-9,
                "{found:?} {expected}"
            ),
            false => assert!(found.is_none(), "{found:?} {expected}"),
        }
    }
}

#[test]
fn of_several_crossings_the_nearest_counts() {
    let terrain = Terrain::sampled(300, 2.0, hill);
    // A ray that only touches the hill is found by small steps; the reference goes along it by a centimetre.
    let from = [-150.0, 7.0, 70.0];
    for down in 0..40 {
        let ray = [1.0, -0.02, -0.005 * f64::from(down)];
        let along = |t: f64| [from[0] + t, from[1] - 0.02 * t, from[2] + ray[2] * t];
        let first = (1..60_000).map(|k| 0.01 * f64::from(k)).find(|t| {
            let [x, y, z] = along(*t);
            terrain.at([x, y]).is_some_and(|ground| z <= ground.z_m)
        });
        let found = terrain.cross(&from.into(), &ray.into()).map(|found| found.reach);
        match (first, found) {
            (Some(first), Some(found)) => assert!((0.0..=0.0101).contains(&(first - found)), "{first} {found}"),
            (None, None) => {}
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn rays_that_start_below_or_off_the_map_or_leave_it_meet_nothing() {
    let terrain = Terrain::sampled(50, 4.0, hill);
    assert!(
        cross(&terrain, [100.0, 0.0, 59.0], [0.0, 0.0, -1.0]).is_none(),
        "inside the hill"
    );
    assert!(cross(&terrain, [100.0, 0.0, 61.0], [0.0, 0.0, -1.0]).is_some());
    assert!(cross(&terrain, [100.0, 0.0, 61.0], [0.0, 0.0, 1.0]).is_none());
    assert!(cross(&terrain, [201.0, 0.0, 300.0], [-1.0, 0.0, -1.0]).is_none());
    assert!(cross(&terrain, [0.0, 0.0, 300.0], [1.0, 0.0, -1.0]).is_none());
    assert!(cross(&terrain, [0.0, 0.0, 30.0], [0.0, 0.0, 0.0]).is_none());
    assert!(cross(&terrain, [0.0, 0.0, 30.0], [1.0, 0.0, 0.0]).is_some());
    assert!(cross(&terrain, [0.0, 0.0, f64::NAN], [0.0, 0.0, -1.0]).is_none());
    assert!(cross(&terrain, [0.0, 0.0, 30.0], [f64::NAN, 0.0, -1.0]).is_none());
}

#[test]
fn a_void_hides_what_passes_low_over_it_and_nothing_else() {
    let terrain = Terrain::sampled(200, 4.0, |x, y| match (x + 40.0).hypot(y) < 10.0 {
        true => f64::NAN,
        false => hill(x, y),
    });
    assert!(cross(&terrain, [-40.0, 0.0, 300.0], [0.0, 0.0, -1.0]).is_none());
    assert!(
        cross(&terrain, [-300.0, 0.0, 300.0], [1.0, 0.0, -0.7]).is_some(),
        "61 m above the hilltop"
    );
    assert!(cross(&terrain, [-300.0, 0.0, 20.0], [1.0, 0.0, -0.05]).is_none());
}
