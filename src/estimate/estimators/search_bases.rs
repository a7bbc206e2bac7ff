//! Which bases a frame is searched in.

use crate::estimate::detect::matrix_pencil::PencilSampler;
use crate::estimate::model::svd_basis::Basis;
use crate::optics::Camera;

/// Reach of a spot, σ, and its share outside the basis, by which the kind of basis is chosen.
const REACH: f64 = 5.3;
const TYPICAL_TAIL: f64 = 1e-5;

/// The bases to search in, and where these span the whole frame, others that leave a part to measure the noise.
pub(crate) fn bases(camera: &Camera) -> ([Basis; 2], Option<[Basis; 2]>) {
    let sigma = camera.spot_sigma_m;
    if camera.spot_shape.is_some() {
        return ([&camera.x, &camera.y].map(|axis| Basis::pixels(axis, sigma)), None);
    }
    let [bx, by] = [&camera.x, &camera.y].map(|axis| Basis::new(axis, sigma));
    let window = |b: &Basis| (2.0 * REACH / b.pitch()).min(b.n as f64);
    let data_count = (bx.rank(TYPICAL_TAIL) * by.rank(TYPICAL_TAIL)) as f64;
    // Where spots are small against the array, they touch fewer pixels than a basis has numbers.
    let has_small_spots = window(&bx) * window(&by) < 2.0 * data_count && PencilSampler::new(&bx, &by).is_none();
    if has_small_spots {
        let pixels = [&camera.x, &camera.y].map(|axis| Basis::pixels(axis, sigma));
        (pixels, Some([bx, by]))
    } else {
        ([bx, by], None)
    }
}
