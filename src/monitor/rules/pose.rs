//! `pose_inconsistent`: all users are displaced alike, by more than is corrected in silence, or by an error that changes faster than an
//! honest one.

use nalgebra::{Matrix2, Vector2};
use serde_json::json;

use crate::monitor::alert::{AlertKind, Severity};
use crate::monitor::finding::{Cause, Content, Finding};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::pose::wander::MEMORY_S;
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::stats::gaussian::neg_log_p_outside;

/// Share of the tolerated distance that is corrected without an alert, where `pose_limit_m` is left out. A half leaves the other
/// half of the tolerated distance to the users. Not tuned.
const DEFAULT_LIMIT: f64 = 0.5;
/// Share of the limit below which the displacement must fall before its alert ends. Larger lets the alert come and go, smaller
/// holds it after the pose is back. Not tuned.
const ENDS_BELOW: f64 = 0.9;
/// Displacement in units of the limit from which the alert is critical. At the defaults 10 m: larger delays the escalation. Not
/// tuned.
const CRITICAL_RATIO: f64 = 4.0;

const CAUSE: Cause = Cause::System(AlertKind::PoseInconsistent);
const LOST: Cause = Cause::System(AlertKind::PoseLost);

pub fn evaluate(frame: &FrameContext) -> Vec<Finding> {
    let limit = frame
        .config
        .pose_limit_m
        .unwrap_or(DEFAULT_LIMIT * frame.config.tolerated_distance_m);
    let (place, worst) = worst_displacement(frame);
    // What the poses' source itself states is no inconsistency.
    let cov = frame.systematic_cov(place) + frame.view.pose_cov(place);
    let neg_log_p = neg_log_p_outside(worst, &cov, limit);
    let threshold = frame.budget.threshold(TestFamily::Pose, 1.0);
    let is_open = frame.alerts.is_open(&CAUSE);
    // A dragged position is held against where it was and how far that has wandered, not against the error that the poses' source states.
    let change = frame.wander.change();
    let change_cov = Matrix2::identity() * (frame.wander.variance() + 2.0 * frame.wander.wandered());
    let is_dragged = neg_log_p_outside(change, &change_cov, limit) > threshold;
    let is_present = neg_log_p > threshold || is_dragged || (is_open && worst.norm() > ENDS_BELOW * limit);
    if !is_present {
        return vec![Finding::Absent(CAUSE)];
    }
    let severity = if worst.norm() > CRITICAL_RATIO * limit {
        Severity::Critical
    } else {
        Severity::Warning
    };
    let pose = frame.pose.displacement();
    let (agreeing, of) = frame.pose.support();
    let evidence = json!({
        "shift_m": [pose.shift.x, pose.shift.y],
        "turned_deg": pose.turn.to_degrees(),
        "scale": 1.0 + pose.scale,
        "largest_in_view_m": worst.norm(),
        "changed_m": change.norm(),
        "changed_within_s": MEMORY_S,
        "limit_m": limit,
        "users_agreeing": agreeing,
        "users": of,
        "surprise": neg_log_p,
        "threshold": threshold,
    });
    vec![Finding::present(CAUSE, Content::new(severity, evidence))]
}

/// `pose_lost`: no pose has come for longer than is tolerated.
pub fn lost(frame: &FrameContext) -> Vec<Finding> {
    let content = frame.pose_lost_s.map(|age_s| {
        let worst_m = frame.view.middle_and_edges_m().into_iter();
        let worst_m = worst_m
            .map(|p| frame.view.pose_cov(p).trace())
            .fold(0.0, f64::max)
            .sqrt();
        let evidence = json!({
            "pose_age_s": age_s,
            "position_std_m": worst_m,
            "is_any_pose_known": frame.is_placed,
        });
        Content::new(Severity::of_duration(age_s), evidence)
    });
    vec![Finding::of(LOST, content)]
}

/// Where in view our pose error displaces positions most, of the middle and the four edges, and by how much, m.
fn worst_displacement(frame: &FrameContext) -> (Vector2<f64>, Vector2<f64>) {
    let places = frame
        .view
        .middle_and_edges_m()
        .into_iter()
        .map(|p| (p, frame.displacement_at(p)));
    let worst = places.max_by(|a, b| a.1.norm().total_cmp(&b.1.norm()));
    worst.unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::fixture::{Scene, absent, present};
    use crate::monitor::pose::bias::SharedOffset;
    use crate::monitor::pose::consensus::PoseConsensus;
    use crate::monitor::pose::wander::PoseWander;
    use crate::monitor::pose::witness::Witness;

    const USERS: [[f64; 2]; 6] = [
        [0.0, 0.0],
        [50.0, 0.0],
        [0.0, 50.0],
        [-60.0, 0.0],
        [0.0, -70.0],
        [80.0, 80.0],
    ];

    /// The findings where all beams are `shift` away from their claims.
    fn findings(scene: &mut Scene, shift: f64) -> Vec<Finding> {
        let claims = USERS.map(Vector2::from);
        let beams = claims.map(|c| c + Vector2::new(shift, 0.0));
        let witnesses = claims.map(|claimed| Witness {
            claimed,
            variance: 0.01,
            reach_m: 1.0,
        });
        scene.pose = PoseConsensus::default();
        scene.pose.update(&beams, &witnesses, 0.1, 1.0);
        let findings = evaluate(scene.context());
        scene.apply(findings.clone());
        findings
    }

    #[test]
    fn a_common_shift_beyond_the_limit_is_our_own_error() {
        let mut scene = Scene::of_users(&USERS);
        // The limit is half of five metres.
        assert_eq!(absent(&findings(&mut scene, 2.0)), [&CAUSE]);
        assert_eq!(present(&findings(&mut scene, 4.0)), [&CAUSE]);
        let alert = scene.alerts.open().next().unwrap().1;
        assert_eq!(alert.severity, Severity::Warning);
        assert_eq!(
            (&alert.evidence["users_agreeing"], &alert.evidence["limit_m"]),
            (&json!(6), &json!(2.5))
        );
        // It ends below nine tenths of the limit, and is critical beyond four of it.
        assert_eq!(present(&findings(&mut scene, 2.3)), [&CAUSE]);
        assert_eq!(absent(&findings(&mut scene, 2.2)), [&CAUSE]);
        findings(&mut scene, 11.0);
        assert_eq!(scene.alerts.open().next().unwrap().1.severity, Severity::Critical);
    }

    #[test]
    fn a_displacement_that_grows_within_seconds_is_a_dragged_position() {
        let mut scene = Scene::of_users(&USERS);
        let drag = |scene: &mut Scene, speed: f64| {
            for k in 0..600 {
                let seconds = (f64::from(k) * 0.1 - 50.0).max(0.0);
                let shared = SharedOffset {
                    left: Vector2::new(speed * seconds, 0.0),
                    variance: 0.03,
                    ..SharedOffset::default()
                };
                scene.wander.update(Some(shared), &nalgebra::Matrix6::zeros(), 0.1, 1.0);
            }
            evaluate(scene.context())
        };
        assert_eq!(absent(&drag(&mut scene, 0.2)), [&CAUSE]);
        scene.wander = PoseWander::default();
        assert_eq!(present(&drag(&mut scene, 1.0)), [&CAUSE]);
    }

    #[test]
    fn the_limit_can_be_set() {
        let mut scene = Scene::of_users(&USERS);
        scene.config.pose_limit_m = Some(10.0);
        assert_eq!(absent(&findings(&mut scene, 9.0)), [&CAUSE]);
        assert_eq!(present(&findings(&mut scene, 12.0)), [&CAUSE]);
    }
}
