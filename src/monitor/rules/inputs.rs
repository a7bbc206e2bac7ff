//! `sensor_lost`, `claims_stale` and `claims_flooded`: the frames or the claims that everything rests on have stopped, or are more than
//! there is room for.

use serde_json::json;

use crate::claims::WINDOW_S;

use crate::monitor::alert::{AlertKind, Severity};
use crate::monitor::evidence::claimed;
use crate::monitor::finding::{Cause, Content, Finding};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::input::overload::Overload;
use crate::time::seconds;

/// Claim periods for which the whole log may be quiet, where they are longer than `claims_stale_s`.
const QUIET_PERIODS: f64 = 5.0;
/// Claim periods for which one user may be silent while their beam and the log go on: thirty claims in a hundred lost at random
/// leave a gap of twenty once in 10¹⁰. Longer lets a user's claims be held back for longer.
const SILENT_PERIODS: f64 = 20.0;
/// How much longer one user may be silent than the whole log, in `claims_stale_s`.
const USER_PATIENCE: f64 = 4.0;
/// A user whose beam was seen within this is still on, s. Longer calls users silent who have left, shorter interrupts the alert
/// where frames miss the beam. Not measured.
const LIT_S: f64 = 1.0;
/// Silence of the log in units of its limit from which it is critical. At the defaults 30 s: larger delays the escalation. Not
/// tuned.
const CRITICAL_RATIO: f64 = 6.0;

const SENSOR: Cause = Cause::System(AlertKind::SensorLost);
const LOG: Cause = Cause::System(AlertKind::ClaimsStale);
const FLOOD: Cause = Cause::System(AlertKind::ClaimsFlooded);

/// No usable frame for `sensor_lost_s`. Ends with the first usable one.
pub fn sensor_lost(frame: &FrameContext) -> Vec<Finding> {
    let blind_s = frame.sensor.blind_s(frame.now);
    if blind_s >= frame.config.sensor_lost_s {
        let content = Content::new(Severity::Critical, frame.sensor.evidence(frame.now));
        vec![Finding::present(SENSOR, content)]
    } else if blind_s == 0.0 {
        vec![Finding::Absent(SENSOR)]
    } else {
        Vec::new()
    }
}

/// Claims that are refused or shed for want of room or time, or are more than a frame is compared with.
pub fn claims_flooded(frame: &FrameContext) -> Vec<Finding> {
    let Overload {
        squeezed,
        left_out,
        users,
        max_users,
    } = frame.overload;
    if squeezed.total() == 0 && left_out == 0 {
        return vec![Finding::Absent(FLOOD)];
    }
    let raised_at = frame.alerts.raised_at(&FLOOD);
    let severity = if squeezed.shed_known > 0 {
        Severity::Critical
    } else {
        Severity::of_duration(raised_at.map_or(0.0, |since| seconds(since, frame.now)))
    };
    let claims_lost = squeezed.refused + squeezed.shed_new + squeezed.shed_known;
    let evidence = json!({
        "window_s": WINDOW_S,
        "claims_refused": squeezed.refused,
        "claims_shed": squeezed.shed_new,
        "claims_of_known_users_shed": squeezed.shed_known,
        "claims_lost_per_s": claims_lost as f64 / WINDOW_S as f64,
        "users_forgotten_early": squeezed.forgotten_early,
        "log_bytes_skipped": squeezed.skipped_bytes,
        "users": users,
        "max_users": max_users,
        "claims_in_view_not_considered": left_out,
    });
    vec![Finding::present(FLOOD, Content::new(severity, evidence))]
}

/// Nothing new in the log, or nothing new of one user whose beam goes on.
pub fn claims_stale(frame: &FrameContext) -> Vec<Finding> {
    let period_s = frame.timing.period_s().unwrap_or(0.0);
    let limit_s = frame.config.claims_stale_s.max(QUIET_PERIODS * period_s);
    let quiet = frame.claims_quiet_s.filter(|(came, made)| came.max(*made) > limit_s);
    let is_log_stale = frame.alerts.is_open(&LOG) || quiet.is_some();
    let mut findings = of_users(frame, period_s, is_log_stale);
    let content = quiet.filter(|_| expects_claims(frame)).map(|(came, made)| {
        let severity = if came.max(made) > CRITICAL_RATIO * limit_s {
            Severity::Critical
        } else {
            Severity::Warning
        };
        let evidence = json!({
            "newest_came_s_ago": came,
            "newest_made_s_ago": made,
            "limit_s": limit_s,
            "typical_period_s": period_s,
        });
        Content::new(severity, evidence)
    });
    findings.push(Finding::of(LOG, content));
    findings
}

/// A beam whose user's claims have stopped while the others' go on: somebody may hold them back. The whole log's silence is one cause
/// and not one a user.
fn of_users(frame: &FrameContext, period_s: f64, is_log_stale: bool) -> Vec<Finding> {
    let open = frame.alerts.users_with(AlertKind::ClaimsStale);
    let mut findings = Vec::new();
    for claim in &frame.claims {
        let user = claim.claim.user.as_str();
        let is_open = open.contains(user);
        let own_period_s = claim.period_s.unwrap_or(0.0);
        let periods_s = SILENT_PERIODS * own_period_s.clamp(period_s, 10.0 * period_s.max(0.1));
        let limit_s = periods_s.max(USER_PATIENCE * frame.config.claims_stale_s);
        let last_seen = frame.users.get(user).and_then(|u| u.last_seen);
        let is_lit = last_seen.is_some_and(|t| seconds(t, frame.now) < LIT_S);
        let is_silent = !claim.ended && claim.age_s > limit_s && is_lit && (is_open || !is_log_stale);
        if is_silent || is_open {
            let evidence = json!({
                "newest_made_s_ago": claim.age_s,
                "limit_s": limit_s,
                "typical_period_s": period_s,
            });
            let content = Content::new(Severity::Warning, evidence).with_claim(claimed(claim));
            let cause = Cause::User(AlertKind::ClaimsStale, user.to_owned());
            findings.push(Finding::of(cause, is_silent.then_some(content)));
        }
    }
    findings
}

/// A network without users has nothing to say.
fn expects_claims(frame: &FrameContext) -> bool {
    frame.claims.iter().any(|a| !a.ended) || frame.tracker.tracks.iter().any(|t| t.confirmed)
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;

    use super::*;
    use crate::monitor::fixture::{Scene, absent, present};

    #[test]
    fn a_second_without_a_usable_frame_is_a_lost_sensor() {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        scene.frame.sensor.no_frame(scene.frame.now);
        scene.now += SignedDuration::from_millis(900);
        assert!(sensor_lost(scene.context()).is_empty(), "neither lost nor there");
        scene.now += SignedDuration::from_millis(100);
        assert_eq!(present(&sensor_lost(scene.context())), [&SENSOR]);
        scene.sensor = Default::default();
        assert_eq!(absent(&sensor_lost(scene.context())), [&SENSOR]);
    }

    #[test]
    fn beams_that_have_left_the_view_are_not_lost_with_the_sensor() {
        // The view reaches 125 m.
        let places = [[0.0, 0.0], [100.0, 0.0], [140.0, 0.0]];
        let mut scene = Scene::of_users(&places);
        let now = scene.now;
        for (k, claim) in scene.frame.claims.iter_mut().enumerate() {
            claim.before.track = Some(k as u64 + 1);
            claim.before.last_seen = Some(now);
        }
        assert_eq!(scene.visible_users(), 2);
    }

    #[test]
    fn a_quiet_log_is_stale_if_there_is_anybody_to_claim() {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        // Five seconds, by arrival or by the claims' own times.
        for (came, made, is_stale) in [(5.0, 5.0, false), (5.1, 0.0, true), (0.0, 5.1, true)] {
            scene.claims_quiet_s = Some((came, made));
            let findings = claims_stale(scene.context());
            assert_eq!(present(&findings).len(), usize::from(is_stale), "{came} {made}");
        }
        scene.claims_quiet_s = Some((31.0, 31.0));
        let findings = claims_stale(scene.context());
        scene.apply(findings);
        assert_eq!(scene.alerts.open().next().unwrap().1.severity, Severity::Critical);
        let mut empty = Scene::of_users(&[]);
        empty.claims_quiet_s = Some((31.0, 31.0));
        assert_eq!(absent(&claims_stale(empty.context())), [&LOG]);
    }

    #[test]
    fn refused_shed_and_unconsidered_claims_are_a_flood() {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        assert_eq!(absent(&claims_flooded(scene.context())), [&FLOOD]);
        scene.overload.left_out = 1;
        let findings = claims_flooded(scene.context());
        assert_eq!(present(&findings), [&FLOOD]);
        scene.apply(findings);
        scene.overload = Overload::default();
        scene.overload.squeezed.refused = 50;
        let findings = claims_flooded(scene.context());
        scene.apply(findings);
        let alert = |scene: &Scene| scene.alerts.open().next().unwrap().1.clone();
        assert_eq!(alert(&scene).severity, Severity::Warning);
        // In the newest ten seconds.
        assert_eq!(alert(&scene).evidence["claims_lost_per_s"], 5.0);
        scene.overload.squeezed.shed_known = 1;
        let findings = claims_flooded(scene.context());
        scene.apply(findings);
        assert_eq!(
            alert(&scene).severity,
            Severity::Critical,
            "claims of known users are lost"
        );
    }

    #[test]
    fn one_users_claims_that_stop_while_the_beam_goes_on_are_stale() {
        let mut scene = Scene::of_users(&[[0.0, 0.0], [50.0, 0.0]]);
        let silent = Cause::User(AlertKind::ClaimsStale, "u-1".into());
        // Twenty periods of a second.
        scene.claims[1].age_s = 20.0;
        assert!(present(&claims_stale(scene.context())).is_empty());
        scene.claims[1].age_s = 20.1;
        assert_eq!(present(&claims_stale(scene.context())), [&silent]);
        // The whole log's silence is one cause.
        scene.claims_quiet_s = Some((20.0, 20.0));
        assert_eq!(present(&claims_stale(scene.context())), [&LOG]);
        scene.claims_quiet_s = Some((0.0, 0.0));
        let findings = claims_stale(scene.context());
        scene.apply(findings);
        // The beam has been off for a second: that user is unseen, and not silent.
        scene.now += SignedDuration::from_secs(1);
        assert!(absent(&claims_stale(scene.context())).contains(&&silent));
    }

    #[test]
    fn a_user_who_seldom_claims_may_be_silent_for_longer() {
        let mut scene = Scene::of_users(&[[0.0, 0.0], [50.0, 0.0]]);
        scene.claims[1].period_s = Some(3.0);
        scene.claims[1].age_s = 59.0;
        assert!(present(&claims_stale(scene.context())).is_empty());
        scene.claims[1].age_s = 61.0;
        assert_eq!(present(&claims_stale(scene.context())).len(), 1);
    }
}
