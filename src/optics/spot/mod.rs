//! The spot of any lens: a sum of separable terms whose weights vary over the field.
//!
//! S(x, y; u, v) = Σ_k w_k(u, v)·a_k(x)·b_k(y), 1/m², with x and y from the spot's centre and (u, v) its place on the sensor. The
//! profiles a_k and b_k are cubic splines with compact support; the weights w_k are polynomials of the field. A measured spot is such
//! a sum after a singular value decomposition of its template (Eckart and Young, 1936), and a handful of terms suffices.

mod field;
mod layout;
mod profile;
mod shape;
mod template;

pub use field::{Field, FieldPolynomial};
pub use layout::{Layout, TermLayout};
pub use profile::{KnotPlace, Profile};
pub use shape::{Beyond, SpotShape};
pub use template::{Component, Template};
