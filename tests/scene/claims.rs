//! Claims of simulated users.

use oapwatch::claim::ClaimState;

use super::plan;

const USER: &str =
    "rate_hz = 10.0\n[link]\nintegration_time_s = 0.1\n[[user]]\nname = \"u\"\nmotion.still = [10, 20]\n";

#[test]
fn a_session_claims_from_its_first_moment_and_says_when_it_ends() {
    let plan = plan(&format!("{USER}present = {{ from_s = 1.25, until_s = 3.6 }}\n"));
    let claims: Vec<_> = (0..60).flat_map(|k| plan.frame(k).claims).collect();
    let seconds = |c: &oapwatch::claim::Claim| c.time.as_millisecond();
    assert_eq!(claims.iter().map(seconds).collect::<Vec<_>>(), [1250, 2250, 3250, 3600]);
    let active = |c: &oapwatch::claim::Claim| c.state == ClaimState::Active;
    assert!(claims[..3].iter().all(active) && claims[3].state == ClaimState::Ended);
    assert!(claims.iter().all(|c| (c.x_m, c.y_m) == (10.0, 20.0)));
}

#[test]
fn claims_come_late_and_get_lost_and_err_as_often_as_the_scene_says() {
    let plan = plan(&format!(
        "{USER}[claims]\nperiod_s = 0.1\nlost = 0.25\nnoise_m = 2.0\ndelay_s = 0.5\ndelay_spread_s = 1.0\n"
    ));
    let frames = plan.frames(0, 20_000);
    let claims: Vec<_> = frames
        .iter()
        .flat_map(|f| f.claims.iter().map(move |c| (f.frame.time, c)))
        .collect();
    // 20,000 Bernoulli draws: a standard deviation of 61; five of them.
    assert!((claims.len() as f64 - 15_000.0).abs() < 310.0, "{}", claims.len());
    let delays: Vec<f64> = claims
        .iter()
        .map(|(at, c)| at.duration_since(c.time).as_secs_f64())
        .collect();
    // Delivered with the frame after the arrival, at most 0.1 s later.
    assert!(delays.iter().all(|d| (0.5..=1.6).contains(d)));
    let (mean, _) = super::moments(&delays);
    // Uniform from 0.5 to 1.5 and half a frame's waiting: 1.05; five standard errors of 0.0024.
    assert!((mean - 1.05).abs() < 0.012, "{mean}");
    let errors: Vec<f64> = claims.iter().map(|(_, c)| c.x_m - 10.0).collect();
    let (mean, variance) = super::moments(&errors);
    // Five standard errors: 2/√15000 = 0.016 and 4·√(2/15000) = 0.046.
    assert!(mean.abs() < 0.08 && (variance - 4.0).abs() < 0.23, "{mean} {variance}");
}
