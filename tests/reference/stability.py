"""Tables at the hard points, computed with mpmath from the defining formulas; see optics.py.

    python3 tests/reference/stability.py
"""

import random
from pathlib import Path

import mpmath as mp

mp.mp.dps = 60
HERE = Path(__file__).parent


def write(name, header, rows):
    lines = [",".join(header)]
    for row in rows:
        lines.append(",".join(repr(v) if isinstance(v, float) else mp.nstr(v, 20) for v in row))
    (HERE / name).write_text("\n".join(lines) + "\n")
    print(name, len(rows), "rows")


def density(t):
    return mp.exp(-t * t / 2) / mp.sqrt(2 * mp.pi)


def pixel(lo, hi, c, s):
    """Fraction, d/dcentre, d/dsigma of exact inputs. 900 digits outlast the cancellation of the narrowest pixel."""
    with mp.workdps(900):
        a, b = (lo - c) / s, (hi - c) / s
        fraction = (mp.erf(b / mp.sqrt(2)) - mp.erf(a / mp.sqrt(2))) / 2
        d_centre = (density(a) - density(b)) / s
        d_sigma = (a * density(a) - b * density(b)) / s
    return +fraction, +d_centre, +d_sigma


def hard_pixels(rng):
    rows = []
    for width in (1e-15, 1e-12, 1e-9, 1e-6, 1.0, 1e6):
        for out in (0.0, 1e-12, 0.5, 0.999, 1.001, 3.0, 12.0, 20.0, 30.0, 36.0):
            lo = out
            hi = lo + width
            if hi > lo:
                rows.append((lo, hi, 0.0, 1.0) + pixel(*map(mp.mpf, (lo, hi, 0.0, 1.0))))
    return rows


def hard_densities(rng):
    rows = []
    for alpha in (0.05, 0.5, 3.0, 1e3, 1e4):
        for beta in (0.05, 0.999999, 40.0, 9999.5):
            for rho in (1e-30, 1e-6, 0.5, 1.0, 1.0 + 1e-12, 2.0, 50.0):
                a, b, r = map(mp.mpf, (alpha, beta, rho))
                # The integral that defines K, about its saddle point; the trapezoidal rule converges exponentially, so
                # halving the step must change nothing.
                nu, x = abs(a - b), 2 * mp.sqrt(a * b * r)
                centre = mp.asinh(nu / x)

                def ln_k(step):
                    top = nu * centre - x * mp.cosh(centre)
                    total = mp.mpf(1)
                    for side in (step, -step):
                        k = 1
                        while True:
                            t = centre + k * side
                            term = mp.exp(nu * t - x * mp.cosh(t) - top)
                            total += term
                            if term < mp.mpf(10) ** -40 * total:
                                break
                            k += 1
                    return top + mp.log(total * step / 2)

                scale = mp.mpf("0.07") / mp.sqrt(1 + mp.sqrt(nu * nu + x * x))
                with mp.workdps(50):
                    fine = ln_k(scale)
                    assert abs(ln_k(2 * scale) - fine) < mp.mpf("1e-22")
                ln_f = (
                    mp.log(2)
                    + (a + b) / 2 * mp.log(a * b)
                    - mp.loggamma(a)
                    - mp.loggamma(b)
                    + ((a + b) / 2 - 1) * mp.log(r)
                    + fine
                )
                rows.append((alpha, beta, rho, ln_f))
    return rows


def bounds(rng):
    """Cramer-Rao bound on x, y and energy of the first of two emitters d apart along the diagonal, on 16 x 16 pixels of 1 unit,
    sigma 1, noise 1, energies 1000 and `ratio` times that."""
    n, energy = 16, mp.mpf(1000)
    rows = []
    for d in (8.0, 4.0, 2.0, 1.0, 0.5, 0.25):
        for ratio in (1.0, 100.0):
            half = mp.mpf(d) / mp.sqrt(2) / 2
            atoms = []
            for sign, a in ((-1, energy), (1, energy * mp.mpf(ratio))):
                centre = mp.mpf("0.3") + sign * half
                columns = [pixel(mp.mpf(k) - n // 2, mp.mpf(k + 1) - n // 2, centre, mp.mpf(1))[:2] for k in range(n)]
                f, g = [c[0] for c in columns], [c[1] for c in columns]
                atoms += [(f, g, a), (g, f, a), (f, f, mp.mpf(1))]
            dot = lambda u, v: mp.fsum(p * q for p, q in zip(u, v))
            fisher = mp.matrix(6, 6)
            for i, (yi, xi, ai) in enumerate(atoms):
                for j, (yj, xj, aj) in enumerate(atoms):
                    fisher[i, j] = ai * aj * dot(yi, yj) * dot(xi, xj)
            inverse = fisher**-1
            rows.append((d, ratio, inverse[0, 0], inverse[0, 1], inverse[1, 1], inverse[2, 2]))
    return rows


write("hard_pixel.csv", ("lo_m", "hi_m", "centre_m", "sigma_m", "fraction", "d_centre", "d_sigma"), hard_pixels(random.Random(1)))
write("hard_gamma_gamma.csv", ("alpha", "beta", "rho", "ln_density"), hard_densities(random.Random(2)))
write("bound.csv", ("d", "ratio", "xx", "xy", "yy", "energy"), bounds(random.Random(3)))
