//! Patches of pixels, kept for some models: a fit comes back to most places, and sources that a step does not move stay as they are.

use crate::estimate::model::measured_terms::{Span, size};

/// Models for which a patch that none of them shows is kept.
const KEPT: usize = 3;

/// What a patch shows of a measured spot.
#[derive(PartialEq)]
pub(super) struct Place {
    pub u: [f64; 2],
    pub displacement: [f64; 2],
    pub parts: Vec<(f64, f64)>,
    pub origin_m: [f64; 2],
}

/// Arrays of the whole and of the core: (rows, arrays, columns) of each.
#[derive(Default)]
pub(super) struct Patch {
    pub spans: [Span; 2],
    pub arrays: [usize; 2],
    pub values: Vec<f64>,
    place: Option<Place>,
    last_used: usize,
}

/// Patches by index.
#[derive(Default)]
pub(super) struct PatchPool {
    patches: Vec<Patch>,
    models: usize,
}

impl Patch {
    /// Numbers of the whole's arrays and of the core's.
    pub fn lengths(&self) -> [usize; 2] {
        [0, 1].map(|k| self.arrays[k] * size(self.spans[k]).iter().product::<usize>())
    }
}

impl PatchPool {
    pub fn begin_model(&mut self) {
        self.models += 1;
    }

    #[inline(always)]
    pub fn get(&self, index: usize) -> &Patch {
        &self.patches[index]
    }

    /// The patch that shows this, if one still does.
    pub fn find(&mut self, place: &Place) -> Option<usize> {
        let index = self.patches.iter().position(|p| p.place.as_ref() == Some(place))?;
        self.patches[index].last_used = self.models;
        Some(index)
    }

    /// A patch to fill, of so many arrays over the whole and the core, with whatever numbers it held.
    pub fn add(&mut self, place: Option<Place>, spans: [Span; 2], arrays: [usize; 2]) -> (usize, &mut [f64]) {
        let is_free = |p: &Patch| p.last_used + KEPT < self.models;
        let index = self.patches.iter().position(is_free).unwrap_or_else(|| {
            self.patches.push(Patch::default());
            self.patches.len() - 1
        });
        let patch = &mut self.patches[index];
        (patch.spans, patch.arrays, patch.place, patch.last_used) = (spans, arrays, place, self.models);
        let length = patch.lengths().iter().sum();
        if patch.values.len() < length {
            patch.values.resize(length, 0.0);
        }
        (index, &mut patch.values[..length])
    }
}
