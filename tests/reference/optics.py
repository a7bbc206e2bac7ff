"""Tables of the optics, computed with mpmath to 50 digits from their defining formulas.

    python3 tests/reference/optics.py

writes the CSV files beside it. Inputs are drawn as doubles and written so that they read back exactly; results carry 20 digits.
The random points cover the whole promised range (log-uniform); the listed ones are its corners.
"""

import random
from pathlib import Path

import mpmath as mp

mp.mp.dps = 50
HERE = Path(__file__).parent


def write(name, header, rows):
    lines = [",".join(header)]
    for row in rows:
        lines.append(",".join(repr(v) if isinstance(v, float) else mp.nstr(v, 20) for v in row))
    (HERE / name).write_text("\n".join(lines) + "\n")
    print(name, len(rows), "rows")


def log_uniform(rng, lo, hi):
    return lo * (hi / lo) ** rng.random()


def density(t):
    return mp.exp(-t * t / 2) / mp.sqrt(2 * mp.pi)


def pixel(lo, hi, centre, sigma):
    """Fraction, d/dcentre, d/dsigma."""
    lo, hi, c, s = map(mp.mpf, (lo, hi, centre, sigma))
    a, b = (lo - c) / s, (hi - c) / s
    # 200 digits outlast the cancellation of a pixel of 1e-12 sigma 38 sigma out.
    with mp.workdps(200):
        fraction = (mp.erf(b / mp.sqrt(2)) - mp.erf(a / mp.sqrt(2))) / 2
        if a > 0:
            fraction = (mp.erfc(a / mp.sqrt(2)) - mp.erfc(b / mp.sqrt(2))) / 2
        if b < 0:
            fraction = (mp.erfc(-b / mp.sqrt(2)) - mp.erfc(-a / mp.sqrt(2))) / 2
        d_centre = (density(a) - density(b)) / s
        d_sigma = (a * density(a) - b * density(b)) / s
    return +fraction, +d_centre, +d_sigma


def pixels(rng):
    points = []
    for _ in range(700):
        sigma = log_uniform(rng, 1e-6, 1e-1)
        width = sigma * log_uniform(rng, 1e-3, 1e3)
        centre = rng.uniform(-0.015, 0.015)
        # Nearest edge up to ten sigma out, on either side, or the spot inside the pixel.
        where = rng.random()
        if where < 0.4:
            lo = centre + sigma * rng.uniform(0, 10)
        elif where < 0.8:
            lo = centre - sigma * rng.uniform(0, 10) - width
        else:
            lo = centre - width * rng.random()
        points.append((lo, lo + width, centre, sigma))
    for width in (1e-3, 0.03, 0.499, 0.501, 1.0, 30.0, 1e3):
        for out in (-10.0, -4.0, -1.0, -width / 2, 0.0, 1e-9, 1.0, 2.0, 4.0, 9.99, 10.0):
            points.append((out * 1e-3, (out + width) * 1e-3, 0.0, 1e-3))
    return [point + pixel(*point) for point in points]


def settled(compute):
    """mpmath's own error control fails for some Bessel functions (one density came out negative), so two precisions must agree."""
    with mp.workdps(150):
        coarse = compute()
    with mp.workdps(300):
        fine = compute()
    assert abs(coarse - fine) <= abs(fine) * mp.mpf("1e-25"), (coarse, fine)
    return +fine


def gamma_gamma(rng):
    rows = []

    def add(alpha, beta, rho):
        a, b, r = map(mp.mpf, (alpha, beta, rho))
        ln_f = settled(
            lambda: mp.log(2)
            + (a + b) / 2 * mp.log(a * b)
            - mp.loggamma(a)
            - mp.loggamma(b)
            + ((a + b) / 2 - 1) * mp.log(r)
            + mp.log(mp.besselk(abs(a - b), 2 * mp.sqrt(a * b * r)))
        )
        rows.append((alpha, beta, rho, mp.re(ln_f)))

    for _ in range(600):
        alpha, beta = log_uniform(rng, 0.3, 300.0), log_uniform(rng, 0.3, 300.0)
        if rng.random() < 0.5:
            rho = log_uniform(rng, 1e-6, 1e2)
        else:
            rho = rng.gammavariate(alpha, 1 / alpha) * rng.gammavariate(beta, 1 / beta)
        add(alpha, beta, rho)
    for alpha in (0.3, 1.0, 2.0, 17.5, 300.0):
        for beta in (0.3, 1.0, 4.0, 299.99999, 300.0):
            for rho in (1e-9, 1e-3, 1.0, 1.0000001, 30.0):
                add(alpha, beta, rho)
    return rows


def moments(rng):
    rows = []
    for _ in range(120):
        alpha, beta = log_uniform(rng, 0.3, 1e4), log_uniform(rng, 0.3, 1e4)
        order = rng.choice([1.0, 2.0, 3.0, 4.0, 0.5, rng.uniform(-0.29, 6.0)])
        a, b, k = map(mp.mpf, (alpha, beta, order))
        ratio = mp.rf(a, k) * mp.rf(b, k) / (a * b) ** k
        rows.append((alpha, beta, order, ratio))
    return rows


def aperture(rng):
    """The Gaussian over the disc in polar coordinates about the lens, by adaptive quadrature of the Rice density."""
    rows = []

    def add(lens, beam, offset):
        ra, w, d = map(mp.mpf, (lens, beam, offset))
        a, b = 2 * d / w, 2 * ra / w
        def integral(pieces):
            cuts = {mp.mpf(0), b} | {min(b, max(mp.mpf(0), min(a, b) + mp.mpf(k) / pieces)) for k in range(-20 * pieces, 20 * pieces + 1)}
            # quad stops by an absolute error, so the peak's exp(-gap^2/2) is taken out.
            gap = a - min(a, b)
            scaled = lambda t: t * mp.exp((gap - t + a) * (gap + t - a) / 2 - a * t) * mp.besseli(0, a * t)
            return mp.quad(scaled, sorted(cuts)) * mp.exp(-gap * gap / 2)

        with mp.workdps(30):
            value = integral(3)
            # Quadrature can be wrong and not say so: another partition must agree.
            assert abs(integral(2) - value) <= abs(value) * mp.mpf("1e-20"), (lens, beam, offset)
        rows.append((lens, beam, offset, +value))

    for _ in range(150):
        beam = log_uniform(rng, 0.01, 10.0)
        add(log_uniform(rng, 0.01, 1.0) * beam, beam, rng.uniform(0.0, 2.5) * beam)
    for ratio in (1e-4, 0.01, 0.5, 2.0, 20.0):
        for offset in (0.0, 0.5 * ratio, ratio, 1.5 * ratio, ratio + 3.0):
            add(ratio, 1.0, offset)
    return rows


def rytov(rng):
    """Andrews and Phillips, 2005: plane wave (wave 0) and spherical wave (wave 1), no inner scale."""
    rows = []
    for _ in range(60):
        cn2, wavelength, length = log_uniform(rng, 1e-17, 1e-12), rng.choice([850e-9, 1550e-9]), log_uniform(rng, 50.0, 2e4)
        c, lam, dist = map(mp.mpf, (cn2, wavelength, length))
        plane = mp.mpf("1.23") * c * (2 * mp.pi / lam) ** mp.mpf("7/6") * dist ** mp.mpf("11/6")
        for wave, v, large in ((0.0, plane, "1.11"), (1.0, plane * mp.mpf("0.4"), "0.56")):
            sigma = mp.sqrt(v)
            ln_x = mp.mpf("0.49") * v / (1 + mp.mpf(large) * sigma ** mp.mpf("12/5")) ** mp.mpf("7/6")
            ln_y = mp.mpf("0.51") * v / (1 + mp.mpf("0.69") * sigma ** mp.mpf("12/5")) ** mp.mpf("5/6")
            rows.append((cn2, wavelength, length, wave, plane, 1 / mp.expm1(ln_x), 1 / mp.expm1(ln_y)))
    return rows


write("pixel.csv", ("lo_m", "hi_m", "centre_m", "sigma_m", "fraction", "d_centre", "d_sigma"), pixels(random.Random(1)))
write("gamma_gamma.csv", ("alpha", "beta", "rho", "ln_density"), gamma_gamma(random.Random(2)))
write("moment.csv", ("alpha", "beta", "order", "moment"), moments(random.Random(3)))
write("aperture.csv", ("lens_radius_m", "beam_radius_m", "offset_m", "fraction"), aperture(random.Random(4)))
write("rytov.csv", ("cn2", "wavelength_m", "length_m", "spherical", "variance", "alpha", "beta"), rytov(random.Random(5)))
