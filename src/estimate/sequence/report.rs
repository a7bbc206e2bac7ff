//! What is reported of a window: its emitters at the newest frame's time, with the posterior of all frames.

use nalgebra::{DMatrix, DVector};

use crate::estimate::emitter::{Estimate, Flags, Velocity};
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::hypothesis::Nuisances;
use crate::estimate::rules::Rules;
use crate::estimate::sequence::joint_information::STATE;
use crate::estimate::sequence::local_quadratic::{Engine, hypothesis};
use crate::estimate::sequence::motion::{Posterior, posterior, take_out, velocity_on_ground};
use crate::estimate::sequence::window::Window;
use crate::estimate::uncertainty::localise::localise;
use crate::optics::{Axis, Camera};

/// Distance beyond the sensor's edges, σ, from which on a moving platform the tail of a spot does not say where its middle is: a brighter beam
/// farther out looks the same.
const TOLD_BEYOND: f64 = 0.5;

/// The emitters at the newest frame's time; `single` holds that frame, whose noise is `scale` times the configured noise.
pub(crate) fn report(
    single: &mut AnalyticEstimator,
    window: &Window,
    camera: &Camera,
    rules: Rules,
    name: &'static str,
    scale: f64,
    is_over: &dyn Fn() -> bool,
) -> Estimate {
    let sigma = camera.spot_sigma_m;
    let present = window.present(window.time_s);
    let n = present.len();
    let is_still = window.snapshots.last().is_none_or(|s| s.outlook.is_none());
    let posterior = posterior(&window.total, 1.0 / window.unit_m, rules.weigh_speeds);
    let (mut cov, mut lasting_cov) = (None, None);
    let mut budget = WorkBudget::new(is_over);
    let (space, compressed, frame) = single.loaded();
    let mut positions = window.positions(&space.bases);
    if let (Some(Posterior { state, covariance }), Some(newest)) = (&posterior, window.snapshots.last()) {
        let place = |k: usize| STATE * present[k / 2] + k % 2;
        let own = DMatrix::from_fn(2 * n, 2 * n, |r, c| covariance[(place(r), place(c))]);
        let mut engine = Engine {
            bases: &space.bases,
            rules,
            budget: &mut budget,
            workspace: &mut space.workspace,
        };
        let places = window.places(state, window.time_s);
        if let Some(outlook) = &newest.outlook {
            let mut lasting = own.clone();
            take_out(&outlook.shared(&places), &mut lasting, &mut DVector::zeros(2 * n));
            lasting_cov = Some(lasting * window.unit_m.powi(2));
        }
        let (at, own) = newest.on_sensor(&mut engine, window.energies, places, own);
        (positions, cov) = (at, Some(own));
    }
    let mut hypothesis = hypothesis(&positions, window.energies, Nuisances::default());
    hypothesis.converged = true;
    let mut context = FitContext {
        bases: &space.bases,
        compressed,
        rules,
        budget: &mut budget,
        workspace: &mut space.workspace,
    };
    let noise_j = scale * camera.noise_std_j;
    let mut found = localise(
        &mut context,
        &mut hypothesis,
        frame,
        camera,
        noise_j,
        None,
        cov.as_ref(),
    );
    for (e, emitter) in found.emitters.iter_mut().enumerate() {
        emitter.energy_j = emitter.energy_j.max(0.0);
        if let Some(Posterior { state, .. }) = &posterior {
            let velocity = [2, 3].map(|k| state[STATE * present[e] + k]);
            emitter.velocity = Some(if is_still {
                velocity_on_ground(camera, emitter.sensor_m, velocity.map(|v| v * sigma))
            } else {
                let [vx_m_s, vy_m_s] = velocity.map(|v| v * window.unit_m);
                Velocity { vx_m_s, vy_m_s }
            });
        }
        emitter.lasting_cov_m2 = lasting_cov
            .as_ref()
            .map(|cov: &DMatrix<f64>| [0, 1].map(|r| [0, 1].map(|c| cov[(2 * e + r, 2 * e + c)])));
        if is_over() {
            emitter.flags |= Flags::OUT_OF_TIME;
        }
    }
    let mut seen = present.iter().map(|e| window.targets[*e].is_seen(rules));
    let is_told = |[x, y]: [f64; 2]| {
        let reach = |axis: &Axis| axis.half_width() + TOLD_BEYOND * sigma;
        is_still || x.abs() < reach(&camera.x) && y.abs() < reach(&camera.y)
    };
    found
        .emitters
        .retain(|emitter| seen.next().unwrap_or(true) && is_told(emitter.sensor_m));
    Estimate {
        emitters: found.emitters,
        estimator: name,
        is_cut_short: is_over(),
        is_limited: n >= compressed.max_sources(),
        reduced_chi2: found.reduced_chi2,
        spot_error: 0.0,
        saturated_share: frame.saturated_share(),
        condition: found.condition,
        steps: budget.steps,
    }
}
