"""The soft matching of the paper's released code: masses meet over shorter, then longer distances."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

LANES = 16
LEVELS = 10  # exponents -4^7, -4^6, ..., -4^-1, and 0


def build(real):
    lanes2 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    lanes3 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=3)
    scalars2 = ti.types.ndarray(dtype=real, ndim=2)
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    doubles1 = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.func
    def exp2(x: ti.template()):
        """2^x for x <= 0, lane by lane; in float32 as a polynomial, which packs, to 1e-7 of its value."""
        y = x
        if ti.static(real == ti.f32):
            for s in ti.static(range(LANES)):
                bounded = ti.select(x[s] > real(-126.0), x[s], real(-126.0))
                whole = ti.cast(bounded, ti.i32)
                f = (bounded - ti.cast(whole, ti.f32)) * real(0.6931471805599453)
                p = real(1.0 / 5040.0) * f + real(1.0 / 720.0)
                p = p * f + real(1.0 / 120.0)
                p = p * f + real(1.0 / 24.0)
                p = p * f + real(1.0 / 6.0)
                p = p * f + real(0.5)
                p = p * f + real(1.0)
                p = p * f + real(1.0)
                y[s] = p * ti.bit_cast((whole + 127) << 23, ti.f32)
        else:
            y = ti.exp(x * real(0.6931471805599453))
        return y

    @ti.func
    def squared(lanes: ti.template(), pair, tile, x, y, z):
        dx = lanes[0, pair, tile] - x
        dy = lanes[1, pair, tile] - y
        dz = lanes[2, pair, tile] - z
        return dx * dx + dy * dy + dz * dz

    @ti.kernel
    def match(
        a: points3,
        b: points3,
        a_lanes: lanes3,
        b_lanes: lanes3,
        supply: lanes2,
        demand: lanes2,
        demand_flat: scalars2,
        offer: lanes2,
        offer_flat: scalars2,
        request: lanes2,
        request_flat: scalars2,
        cost: doubles1,
        grad_a: lanes3,
        grad_b: lanes3,
        with_gradient: ti.i32,
        spread: ti.i32,
    ):
        """supply and demand come in as the masses of `a` and `b`, 0 in the padding; a `_flat` array is the same memory.

        The match itself is never stored: cost and the sums of unit vectors it weights are built up level by level.
        """
        for step in range(a.shape[0] * spread):
            if step % spread == 0:
                pair = step // spread
                total = ti.cast(0.0, ti.f64)
                zero = ti.Vector([real(0.0) for s in ti.static(range(LANES))])
                for level in range(LEVELS):
                    scale = -ti.pow(real(4.0), real(7.0) - ti.cast(level, real)) * real(1.4426950408889634)
                    scale = ti.select(level == LEVELS - 1, real(0.0), scale)
                    # What each point of `a` offers per unit of weighted demand around it.
                    for t in range(supply.shape[1]):
                        wanted = zero + real(1e-9)
                        for j in range(b.shape[1]):
                            d2 = squared(a_lanes, pair, t, b[pair, j, 0], b[pair, j, 1], b[pair, j, 2])
                            wanted += exp2(d2 * scale) * demand_flat[pair, j]
                        offer[pair, t] = supply[pair, t] / wanted
                    # What each point of `b` takes of it: no more than its demand.
                    for t in range(demand.shape[1]):
                        offered = zero
                        for i in range(a.shape[1]):
                            d2 = squared(b_lanes, pair, t, a[pair, i, 0], a[pair, i, 1], a[pair, i, 2])
                            offered += exp2(d2 * scale) * offer_flat[pair, i]
                        need = demand[pair, t]
                        offered *= need
                        share = need / (offered + real(1e-9))
                        rest = need - offered
                        for s in ti.static(range(LANES)):
                            share[s] = ti.select(share[s] < real(1.0), share[s], real(1.0))
                            rest[s] = ti.select(rest[s] > real(0.0), rest[s], real(0.0))
                        request[pair, t] = share * need
                        demand[pair, t] = rest
                    for t in range(supply.shape[1]):
                        given = zero
                        way = zero
                        gx = zero
                        gy = zero
                        gz = zero
                        for j in range(b.shape[1]):
                            dx = a_lanes[0, pair, t] - b[pair, j, 0]
                            dy = a_lanes[1, pair, t] - b[pair, j, 1]
                            dz = a_lanes[2, pair, t] - b[pair, j, 2]
                            d2 = dx * dx + dy * dy + dz * dz
                            w = exp2(d2 * scale) * request_flat[pair, j]
                            d = ti.sqrt(d2)
                            given += w
                            way += w * d
                            unit = w / ti.max(d, real(1e-20))
                            gx += unit * dx
                            gy += unit * dy
                            gz += unit * dz
                        mass = offer[pair, t]
                        total += ti.cast((way * mass).sum(), ti.f64)
                        grad_a[0, pair, t] += gx * mass
                        grad_a[1, pair, t] += gy * mass
                        grad_a[2, pair, t] += gz * mass
                        left = supply[pair, t] - given * mass
                        for s in ti.static(range(LANES)):
                            left[s] = ti.select(left[s] > real(0.0), left[s], real(0.0))
                        supply[pair, t] = left
                    if with_gradient != 0:
                        for t in range(demand.shape[1]):
                            gx = zero
                            gy = zero
                            gz = zero
                            for i in range(a.shape[1]):
                                dx = b_lanes[0, pair, t] - a[pair, i, 0]
                                dy = b_lanes[1, pair, t] - a[pair, i, 1]
                                dz = b_lanes[2, pair, t] - a[pair, i, 2]
                                d2 = dx * dx + dy * dy + dz * dz
                                w = exp2(d2 * scale) * offer_flat[pair, i] / ti.max(ti.sqrt(d2), real(1e-20))
                                gx += w * dx
                                gy += w * dy
                                gz += w * dz
                            mass = request[pair, t]
                            grad_b[0, pair, t] += gx * mass
                            grad_b[1, pair, t] += gy * mass
                            grad_b[2, pair, t] += gz * mass
                cost[pair] = total

    return SimpleNamespace(match=match)
