//! What is fitted: the data and what predicts them.

use crate::estimate::fit::profile_constraint::ProfileConstraint;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;

/// The data of a fit and what predicts them.
#[derive(Clone, Copy)]
pub(crate) struct Problem<'a> {
    pub bases: &'a Bases,
    pub compressed: &'a CompressedFrame,
    /// Holds the positions near a hyperplane, if set.
    pub constraint: Option<&'a ProfileConstraint>,
}
