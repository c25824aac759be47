"""The soft matching of the paper's released code: masses are matched at short, then at longer distances."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

LANES = 16
LEVELS = 10  # exponents -4^7, -4^6, ..., -4^-1, and 0
# Coefficients of 2^x on [-1, 0], highest power first: minimax in relative error (2e-9), exactly 1 at 0.
POLYNOMIAL = (
    0.000109023228318475,
    0.0012747482896728335,
    0.009579179659358492,
    0.05549075706534974,
    0.2402243678160244,
    0.6931470643268492,
    1.0,
)


def build(real):
    lanes2 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    lanes3 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=3)
    scalars2 = ti.types.ndarray(dtype=real, ndim=2)
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    doubles1 = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.func
    def exp2(x):
        """2^x for x <= 0, lane by lane; in float32 a polynomial, which is vectorised, with a relative error of 1e-7."""
        y = x
        if ti.static(real == ti.f32):
            for s in ti.static(range(LANES)):
                bounded = ti.select(x[s] > real(-126.0), x[s], real(-126.0))
                whole = ti.cast(bounded, ti.i32)
                f = bounded - ti.cast(whole, ti.f32)
                p = real(POLYNOMIAL[0])
                for k in ti.static(range(1, len(POLYNOMIAL))):
                    p = p * f + real(POLYNOMIAL[k])
                y[s] = p * ti.bit_cast((whole + 127) << 23, ti.f32)
        else:
            y = ti.exp(x * real(0.6931471805599453))
        return y

    @ti.func
    def squared(x_lanes, y_lanes, z_lanes, x, y, z):
        dx = x_lanes - x
        dy = y_lanes - y
        dz = z_lanes - z
        return dx * dx + dy * dy + dz * dz

    @ti.func
    def add_directions(
        lanes: ti.template(),
        others: ti.template(),
        other_mass: ti.template(),
        mass: ti.template(),
        sums: ti.template(),
        gradient: ti.template(),
        pair,
        tile,
        scale,
    ):
        """Adds the unit vectors from the other set's points to those of a tile, weighted by the match."""
        x, y, z = lanes[0, pair, tile], lanes[1, pair, tile], lanes[2, pair, tile]
        for k in range(3):
            here = lanes[k, pair, tile]
            total = here * real(0.0)
            for j in range(others.shape[1]):
                d2 = squared(x, y, z, others[pair, j, 0], others[pair, j, 1], others[pair, j, 2])
                d = ti.sqrt(d2)
                for s in ti.static(range(LANES)):
                    d[s] = ti.select(d[s] > real(1e-20), d[s], real(1e-20))
                total += exp2(d2 * scale) * other_mass[pair, j] / d * (here - others[pair, j, k])
            sums[k, pair, tile] = total
        for k in range(3):
            gradient[k, pair, tile] = sums[k, pair, tile] * mass[pair, tile] + gradient[k, pair, tile]

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
        taken: lanes2,
        path: lanes2,
        cost: doubles1,
        sums_a: lanes3,
        sums_b: lanes3,
        grad_a: lanes3,
        grad_b: lanes3,
        with_gradient: ti.i32,
        spread: ti.i32,
    ):
        """supply and demand must be the masses of `a` and `b`, 0 in the padding; a `_flat` array is the same memory.

        The match itself is never stored: the cost and the weighted sums of unit vectors are accumulated level by level.
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
                        x, y, z = a_lanes[0, pair, t], a_lanes[1, pair, t], a_lanes[2, pair, t]
                        wanted = zero + real(1e-9)
                        for j in range(b.shape[1]):
                            d2 = squared(x, y, z, b[pair, j, 0], b[pair, j, 1], b[pair, j, 2])
                            wanted += exp2(d2 * scale) * demand_flat[pair, j]
                        offer[pair, t] = supply[pair, t] / wanted
                    # What each point of `b` takes of it: no more than its demand.
                    for t in range(demand.shape[1]):
                        x, y, z = b_lanes[0, pair, t], b_lanes[1, pair, t], b_lanes[2, pair, t]
                        offered = zero
                        for i in range(a.shape[1]):
                            d2 = squared(x, y, z, a[pair, i, 0], a[pair, i, 1], a[pair, i, 2])
                            offered += exp2(d2 * scale) * offer_flat[pair, i]
                        request[pair, t] = offered
                    for t in range(demand.shape[1]):
                        need = demand[pair, t]
                        offered = request[pair, t] * need
                        share = need / (offered + real(1e-9))
                        rest = need - offered
                        for s in ti.static(range(LANES)):
                            share[s] = ti.select(share[s] < real(1.0), share[s], real(1.0))
                            rest[s] = ti.select(rest[s] > real(0.0), rest[s], real(0.0))
                        request[pair, t] = share * need
                        demand[pair, t] = rest
                    for t in range(supply.shape[1]):
                        x, y, z = a_lanes[0, pair, t], a_lanes[1, pair, t], a_lanes[2, pair, t]
                        given = zero
                        for j in range(b.shape[1]):
                            d2 = squared(x, y, z, b[pair, j, 0], b[pair, j, 1], b[pair, j, 2])
                            given += exp2(d2 * scale) * request_flat[pair, j]
                        taken[pair, t] = given
                    for t in range(supply.shape[1]):
                        x, y, z = a_lanes[0, pair, t], a_lanes[1, pair, t], a_lanes[2, pair, t]
                        way = zero
                        for j in range(b.shape[1]):
                            d2 = squared(x, y, z, b[pair, j, 0], b[pair, j, 1], b[pair, j, 2])
                            way += exp2(d2 * scale) * request_flat[pair, j] * ti.sqrt(d2)
                        path[pair, t] = way
                    for t in range(supply.shape[1]):
                        mass = offer[pair, t]
                        total += ti.cast((path[pair, t] * mass).sum(), ti.f64)
                        left = supply[pair, t] - taken[pair, t] * mass
                        for s in ti.static(range(LANES)):
                            left[s] = ti.select(left[s] > real(0.0), left[s], real(0.0))
                        supply[pair, t] = left
                    if with_gradient != 0:
                        for t in range(supply.shape[1]):
                            add_directions(a_lanes, b, request_flat, offer, sums_a, grad_a, pair, t, scale)
                        for t in range(demand.shape[1]):
                            add_directions(b_lanes, a, offer_flat, request, sums_b, grad_b, pair, t, scale)
                cost[pair] = total

    return SimpleNamespace(match=match)
