//! The search for the number of emitters: hypotheses are fitted jointly and held against each other.

use super::fit::{Fitter, Model, Nuisances, Spot};
use super::heatmap::Heatmap;
use super::reading::Reading;

/// Emitters a frame may hold at most.
const MOST: usize = 80;
/// Two greedy peaks of one round stand at least this far apart, σ.
const SEPARATION: f64 = 2.5;

/// The search's settings that follow from the camera.
pub(super) struct Search {
    pub fitter: Fitter,
    pub heatmap: Heatmap,
    /// Least drop of the deviance that an emitter must bring.
    pub price: f64,
}

impl Search {
    pub fn new(fitter: Fitter) -> Self {
        let heatmap = Heatmap::new(&fitter.bx, &fitter.by);
        let area = |b: &super::basis::Basis| b.edges[b.n] - b.edges[0];
        // False alarms: the matched filter has about area/σ² independent positions, each exceeding 13 by chance
        // in less than 1e-3 of 6 + 2 ln(area/σ²).
        let price = (6.0 + 2.0 * (area(&fitter.bx) * area(&fitter.by)).ln()).max(13.0);
        Self { fitter, heatmap, price }
    }

    /// Adds peaks of the residual until none is significant, refitting all emitters each time.
    pub fn greedy(&mut self, reading: &Reading, nuisances: Nuisances, steps: usize) -> Model {
        let mut model = Model::empty(nuisances);
        let mut residual = Vec::new();
        loop {
            residual.clear();
            residual.extend_from_slice(self.fitter.residual_of(reading, &mut model));
            self.fitter.clean(reading, nuisances, &mut residual);
            let peaks = self
                .heatmap
                .peaks(&residual, reading.mx, reading.my, self.price.sqrt(), SEPARATION);
            let Some(strongest) = peaks.first() else { break };
            if model.spots.len() >= MOST {
                break;
            }
            let least = 0.1 * strongest.significance;
            let mut next = model.clone();
            next.spots.extend(
                peaks
                    .iter()
                    .filter(|p| p.significance >= least)
                    .take(MOST - model.spots.len())
                    .map(|p| Spot { u: p.u, a: p.a }),
            );
            self.fitter.fit(reading, &mut next, steps);
            let added = (next.spots.len() - model.spots.len()) as f64;
            if next.deviance + self.price * added > model.deviance {
                break;
            }
            model = next;
        }
        self.drop_insignificant(reading, &mut model, steps);
        model
    }

    /// Drops emitters, weakest first, as long as the fit without them is worse by less than their price.
    pub fn drop_insignificant(&mut self, reading: &Reading, model: &mut Model, steps: usize) {
        while !model.spots.is_empty() {
            let weakest = (0..model.spots.len())
                .min_by(|&i, &j| model.spots[i].a.total_cmp(&model.spots[j].a))
                .expect("not empty");
            let mut next = model.clone();
            next.spots.remove(weakest);
            self.fitter.fit(reading, &mut next, steps);
            if next.deviance > model.deviance + self.price {
                break;
            }
            *model = next;
        }
    }
}
