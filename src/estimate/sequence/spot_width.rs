//! The spots' width, learned from the frames that `sequence` explains.

use nalgebra::DVector;

use crate::estimate::emitter::Estimate;
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::estimators::budgets::Budgets;
use crate::estimate::estimators::frame_search::SearchKind;
use crate::estimate::model::hypothesis::{Nuisances, Width};
use crate::estimate::sequence::local_quadratic::{Energies, hypothesis};

/// Has `single` learn from its loaded frame, in which these emitters were found. Whether its spots are of another width now.
pub(crate) fn learn_width(single: &mut AnalyticEstimator, found: &Estimate, is_over: &dyn Fn() -> bool) -> bool {
    if found.spot_error > 0.0 || !single.is_width_due() {
        return false;
    }
    let sigma = single.camera().spot_sigma_m;
    let at = found.emitters.iter().flat_map(|e| e.sensor_m);
    let positions = DVector::from_vec(at.map(|v| v / sigma).collect());
    let mut budgets = Budgets::new(is_over);
    let width = Nuisances {
        width: Width::Common,
        ..Nuisances::default()
    };
    let mut shown = hypothesis(&positions, Energies::NonNegative, width);
    single.again(&mut budgets).fit_trial(&mut shown);
    shown.sources.retain(|source| source.a > 0.0);
    single.learn_width(SearchKind::Main, &shown, &mut budgets)
}
