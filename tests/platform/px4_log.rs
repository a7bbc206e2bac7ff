//! Flight logs of PX4: cuts of real ones (tests/data/px4/README.md).

use std::path::{Path, PathBuf};

use oapwatch::platform::{Origin, px4_log};
use oapwatch::pose::PoseSigmas;
use oapwatch::ulog;

fn log(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/px4").join(name)
}

#[test]
fn a_hovering_flight_is_read_as_pyulog_reads_it() {
    let log = ulog::read(&log("hover.ulg")).unwrap();
    assert_eq!(
        (log.attitudes.len(), log.places.len(), log.is_cut_off),
        (368, 185, false)
    );
    let first = log.attitudes[0].q;
    for (found, expected) in first
        .iter()
        .zip([0.473_179_94, 0.015_848_316, -0.012_075_77, -0.880_740_5])
    {
        assert!((found - expected).abs() < 1e-7, "{first:?}");
    }
    let place = log.places[0];
    for (found, expected) in place.ned_m.iter().zip([0.616_506_2, -3.022_343_2, -16.821_363]) {
        assert!((found - expected).abs() < 1e-6, "{place:?}");
    }
    assert!((place.reference[2] + 8.582_35).abs() < 1e-5 && (place.sigma_m[0] - 0.171_017_81).abs() < 1e-7);
    assert!(log.utc_minus_boot_us.is_some() && log.undulation_m.is_some());

    let poses = px4_log::poses(&log, PoseSigmas::default());
    assert!(poses.len() > 350, "{}", poses.len());
    let heights: Vec<f64> = poses.iter().map(|p| p.place.enu_m[2]).collect();
    assert!(heights.iter().all(|h| (16.0..19.0).contains(h)));
    assert!(poses.is_sorted_by_key(|p| p.time_us) && poses.iter().all(|p| matches!(p.place.origin, Origin::Start(_))));
    assert!((poses[0].cov[(3, 3)].sqrt() - 0.171).abs() < 0.001);
}

#[test]
fn a_log_without_a_position_has_attitudes_and_no_poses() {
    let log = ulog::read(&log("sway.ulg")).unwrap();
    assert_eq!((log.attitudes.len(), log.places.len()), (6461, 0));
    assert_eq!((log.utc_minus_boot_us, log.undulation_m), (None, None));
    assert!(px4_log::poses(&log, PoseSigmas::default()).is_empty());
}

#[test]
fn a_log_that_ends_early_gives_what_it_has_and_another_file_a_message() {
    let bytes = std::fs::read(log("hover.ulg")).unwrap();
    let cut = ulog::read_from(&bytes[..bytes.len() / 2]).unwrap();
    assert!(cut.is_cut_off && (100..368).contains(&cut.attitudes.len()));
    let Err(ulog::Fault::Malformed(0, message)) = ulog::read_from(&b"x_m,y_m\n1,2\n3,4,5,6\n"[..]) else {
        panic!("no log");
    };
    assert!(message.contains("PX4 log"), "{message}");
    let refused = ulog::read(Path::new("/nonexistent/flight.ulg"))
        .unwrap_err()
        .to_string();
    assert!(refused.starts_with("/nonexistent/flight.ulg"), "{refused}");
}
