"""Assignment by auction: persons bid for objects at rising prices, with a decreasing bid increment (epsilon).

Bertsekas' Gauss-Seidel auction with epsilon scaling, one pair of clouds per thread. Where there are fewer persons
than objects, dummy persons with distance 0 to every object are added: the problem becomes symmetric, and the bound
below holds.

After each phase the duality gap is measured. For any prices p,
    sum_i min_j (c_ij + p_j) - sum_j p_j  <=  cost of the optimal assignment,
so the cost is at most its difference from this bound above the optimum; the auction stops when that is small enough.
"""

from types import SimpleNamespace

from diffpoint._auction import COARSEST, ENOUGH, FAR, SCALING
from diffpoint.kernels._backend import ti

LANES = 16


def build(real):
    persons3 = ti.types.ndarray(dtype=real, ndim=3)
    lanes2 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    scalars2 = ti.types.ndarray(dtype=real, ndim=2)
    integers2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
    counts1 = ti.types.ndarray(dtype=ti.i64, ndim=1)
    reals1 = ti.types.ndarray(dtype=real, ndim=1)
    doubles1 = ti.types.ndarray(dtype=ti.f64, ndim=1)
    flags1 = ti.types.ndarray(dtype=ti.u8, ndim=1)
    clouds3 = ti.types.ndarray(dtype=real, ndim=3)
    indices2 = ti.types.ndarray(dtype=ti.i64, ndim=2)

    @ti.func
    def distance(dx, dy, dz):
        return ti.sqrt(dx * dx + dy * dy + dz * dz)

    @ti.func
    def squared_distance(dx, dy, dz):
        return dx * dx + dy * dy + dz * dz

    def auction_by(cost_of):
        """The kernel for one cost of a match, a function of the difference of two points."""

        @ti.func
        def two_cheapest(
            x_lanes: ti.template(),
            y_lanes: ti.template(),
            z_lanes: ti.template(),
            price_lanes: ti.template(),
            pair: ti.i32,
            x: real,
            y: real,
            z: real,
            weight: real,
        ):
            """The cheapest object at cost times weight plus price, its total, and the total of the second."""
            first = ti.Vector([real(FAR) for s in ti.static(range(LANES))])
            second = ti.Vector([real(FAR) for s in ti.static(range(LANES))])
            first_tile = ti.Vector([0 for s in ti.static(range(LANES))])
            # The array's own size as the bound: with a computed one the loop is not vectorised (5x slower).
            for t in range(x_lanes.shape[1]):
                dx = x_lanes[pair, t] - x
                dy = y_lanes[pair, t] - y
                dz = z_lanes[pair, t] - z
                total = weight * cost_of(dx, dy, dz) + price_lanes[pair, t]
                for s in ti.static(range(LANES)):
                    cheaper = total[s] < first[s]
                    loser = ti.select(cheaper, first[s], total[s])
                    second[s] = ti.select(loser < second[s], loser, second[s])
                    first_tile[s] = ti.select(cheaper, t, first_tile[s])
                    first[s] = ti.select(cheaper, total[s], first[s])
            best = first[0]
            best_object = first_tile[0] * LANES
            next_best = second[0]
            for s in ti.static(range(1, LANES)):
                cheaper = first[s] < best
                loser = ti.select(cheaper, best, first[s])
                next_best = ti.min(next_best, loser, second[s])
                best_object = ti.select(cheaper, first_tile[s] * LANES + s, best_object)
                best = ti.select(cheaper, first[s], best)
            return best_object, best, next_best

        @ti.kernel
        def auction(
            persons: persons3,
            objects: persons3,
            x_lanes: lanes2,
            y_lanes: lanes2,
            z_lanes: lanes2,
            price_lanes: lanes2,
            price: scalars2,
            person_counts: counts1,
            object_counts: counts1,
            largest_cost: reals1,
            start_cost: reals1,
            enough: reals1,
            object_of: integers2,
            person_of: integers2,
            queue: integers2,
            bound: doubles1,
            finished: flags1,
            tolerance: ti.f64,
            resolution: ti.f64,
            bids_per_person: ti.i32,
            spread: ti.i32,
        ):
            """`price` and `price_lanes` are the same memory: first the prices to start from, at the end the final ones.

            start_cost: the mean cost of the pair that the prices to start from belong to; negative if all prices are 0.
            enough: the auction stops once the lower bound of the optimal mean cost reaches this.
            bound: upper bound of the mean cost minus the optimum.
            """
            for step in range(persons.shape[0] * spread):
                if step % spread == 0:
                    pair = step // spread
                    n = ti.cast(person_counts[pair], ti.i32)
                    m = ti.cast(object_counts[pair], ti.i32)
                    for j in range(price.shape[1]):
                        price[pair, j] = ti.select(j < m, price[pair, j], real(FAR))
                    smallest_epsilon = ti.cast(ti.cast(largest_cost[pair], ti.f64) * resolution, real)
                    coarsest = ti.max(largest_cost[pair] * real(COARSEST), smallest_epsilon)
                    epsilon = coarsest
                    proof_wanted = ti.cast(enough[pair], ti.f64) * n
                    proven = ti.cast(-1.0, ti.f64)
                    if start_cost[pair] >= 0 or enough[pair] < FAR:
                        proven = 0.0
                        for i in range(m):
                            row = ti.min(i, n - 1)
                            weight = ti.select(i < n, real(1.0), real(0.0))
                            _, cheapest, _ = two_cheapest(
                                x_lanes,
                                y_lanes,
                                z_lanes,
                                price_lanes,
                                pair,
                                persons[pair, row, 0],
                                persons[pair, row, 1],
                                persons[pair, row, 2],
                                weight,
                            )
                            proven += ti.cast(cheapest, ti.f64) - ti.cast(price[pair, i], ti.f64)
                    if start_cost[pair] >= 0:
                        # The lower bound from the start prices tells how well they fit this pair, and so the first
                        # epsilon: the difference between the earlier cost and the bound is about how far the pair has
                        # moved.
                        least = ti.cast(proven / n, real)
                        known = ti.max(start_cost[pair], least)
                        moved = ti.max(start_cost[pair] - least, least - start_cost[pair])
                        epsilon = ti.max(known * ti.cast(tolerance * ENOUGH, real), moved, smallest_epsilon)
                        if not epsilon < coarsest:
                            epsilon = coarsest
                            for j in range(m):
                                price[pair, j] = 0.0
                    best_lower_bound = ti.cast(-1.0, ti.f64)
                    bids = ti.cast(0, ti.i64)
                    bid_limit = ti.cast(bids_per_person, ti.i64) * ti.cast(m, ti.i64)
                    bound[pair] = 0.0
                    finished[pair] = ti.u8(1)
                    running = n > 0
                    waiting = m
                    for i in range(m):
                        object_of[pair, i] = -1
                        person_of[pair, i] = -1
                        queue[pair, i] = i
                    if proven >= proof_wanted:
                        # The start prices are enough (prices of 0 give the distance to the nearest object): any
                        # assignment.
                        running = False
                        cost = ti.cast(0.0, ti.f64)
                        for i in range(m):
                            object_of[pair, i] = i
                            person_of[pair, i] = i
                            if i < n:
                                dx = persons[pair, i, 0] - objects[pair, i, 0]
                                dy = persons[pair, i, 1] - objects[pair, i, 1]
                                dz = persons[pair, i, 2] - objects[pair, i, 2]
                                cost += ti.cast(cost_of(dx, dy, dz), ti.f64)
                        bound[pair] = ti.max(cost - proven, 0.0) / n
                    while running:
                        head = 0
                        while waiting > 0 and bids < bid_limit:
                            i = queue[pair, head]
                            head = ti.select(head + 1 == m, 0, head + 1)
                            waiting -= 1
                            weight = ti.select(i < n, real(1.0), real(0.0))
                            row = ti.min(i, n - 1)
                            j, best, next_best = two_cheapest(
                                x_lanes,
                                y_lanes,
                                z_lanes,
                                price_lanes,
                                pair,
                                persons[pair, row, 0],
                                persons[pair, row, 1],
                                persons[pair, row, 2],
                                weight,
                            )
                            # A single object has no second best offer, so its price rises by epsilon only.
                            rise = ti.select(m > 1, next_best - best, real(0.0)) + epsilon
                            price[pair, j] = (
                                price[pair, j] + rise
                            )  # not +=, which would be an atomic addition
                            outbid = person_of[pair, j]
                            person_of[pair, j] = i
                            object_of[pair, i] = j
                            if outbid >= 0:
                                object_of[pair, outbid] = -1
                                tail = head + waiting
                                tail = ti.select(tail >= m, tail - m, tail)
                                queue[pair, tail] = outbid
                                waiting += 1
                            bids += 1
                        if waiting > 0:
                            # No bids left: unassigned persons take free objects in order.
                            free = 0
                            for i in range(m):
                                if object_of[pair, i] < 0:
                                    while person_of[pair, free] >= 0:
                                        free += 1
                                    object_of[pair, i] = free
                                    person_of[pair, free] = i
                            finished[pair] = ti.u8(0)
                        finer = ti.max(epsilon / real(SCALING), smallest_epsilon)
                        cost = ti.cast(0.0, ti.f64)
                        lower_bound = ti.cast(0.0, ti.f64)
                        dissatisfied = 0
                        for i in range(m):
                            row = ti.min(i, n - 1)
                            weight = ti.select(i < n, real(1.0), real(0.0))
                            j = object_of[pair, i]
                            dx = persons[pair, row, 0] - objects[pair, j, 0]
                            dy = persons[pair, row, 1] - objects[pair, j, 1]
                            dz = persons[pair, row, 2] - objects[pair, j, 2]
                            paid = weight * cost_of(dx, dy, dz)
                            cost += ti.cast(paid, ti.f64)
                            _, cheapest, _ = two_cheapest(
                                x_lanes,
                                y_lanes,
                                z_lanes,
                                price_lanes,
                                pair,
                                persons[pair, row, 0],
                                persons[pair, row, 1],
                                persons[pair, row, 2],
                                weight,
                            )
                            lower_bound += ti.cast(cheapest, ti.f64) - ti.cast(price[pair, i], ti.f64)
                            # A person within the next epsilon of the best offer keeps the object; the others bid again.
                            if paid + price[pair, j] > cheapest + finer:
                                queue[pair, dissatisfied] = i
                                dissatisfied += 1
                        best_lower_bound = ti.max(best_lower_bound, lower_bound)
                        gap = ti.max(cost - best_lower_bound, 0.0)
                        bound[pair] = gap / n
                        good = gap <= tolerance * cost or best_lower_bound >= proof_wanted
                        if good or finished[pair] == 0:
                            running = False
                        elif epsilon <= smallest_epsilon:
                            # The resolution of the dtype is reached; the remaining gap is rounding unless it is large.
                            if gap / n > 10.0 * ti.cast(smallest_epsilon, ti.f64):
                                finished[pair] = ti.u8(0)
                            running = False
                        else:
                            epsilon = finer
                            waiting = dissatisfied
                            for q in range(waiting):
                                i = queue[pair, q]
                                person_of[pair, object_of[pair, i]] = -1
                                object_of[pair, i] = -1

        return auction

    @ti.kernel
    def backward(
        a: clouds3,
        b: clouds3,
        assignment: indices2,
        grad_mean: reals1,
        grad_a: clouds3,
        grad_b: clouds3,
        squared: ti.i32,
        spread: ti.i32,
    ):
        """The gradient of the mean times unit vectors between matched points, or twice their differences if `squared`;
        0 for matched points that coincide.
        """
        for step in range(a.shape[0] * spread):
            if step % spread == 0:
                pair = step // spread
                g = grad_mean[pair]
                for i in range(a.shape[1]):
                    j = ti.cast(assignment[pair, i], ti.i32)
                    if j >= 0:
                        dx = a[pair, i, 0] - b[pair, j, 0]
                        dy = a[pair, i, 1] - b[pair, j, 1]
                        dz = a[pair, i, 2] - b[pair, j, 2]
                        d = distance(dx, dy, dz)
                        scale = ti.select(d > 0, g / ti.select(d > 0, d, real(1.0)), real(0.0))
                        scale = ti.select(squared != 0, real(2.0) * g, scale)
                        grad_a[pair, i, 0] = dx * scale
                        grad_a[pair, i, 1] = dy * scale
                        grad_a[pair, i, 2] = dz * scale
                        grad_b[pair, j, 0] = -dx * scale
                        grad_b[pair, j, 1] = -dy * scale
                        grad_b[pair, j, 2] = -dz * scale

    return SimpleNamespace(
        auction=auction_by(distance), auction_of_squares=auction_by(squared_distance), backward=backward
    )
