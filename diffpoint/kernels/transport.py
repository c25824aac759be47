"""Assignment by auction: persons bid for objects at rising prices, with a decreasing bid increment (epsilon).

Bertsekas' auction with epsilon scaling, one pair of clouds per thread. Where there are fewer persons than objects,
dummy persons with cost 0 for every object are added: the problem becomes symmetric, and the bound below holds.

A scan of all objects for a person leaves a list of 16 offers, and a lower bound on the totals (cost plus price) of all
other objects. As prices only rise, the list is good until its best offer exceeds that bound: most bids need no scan.
The scans that are needed are made in rounds of a fixed number of persons, all at the same prices. Other threads can
help with a round, and a list is the same whoever makes it, so that the result does not depend on them.

After each phase the duality gap is measured. For any prices p,
    sum_i min_j (c_ij + p_j) - sum_j p_j  <=  cost of the optimal assignment,
so the cost is at most its difference from this bound above the optimum; the auction stops when that is small enough.
"""

from types import SimpleNamespace

from diffpoint._auction import (
    COARSEST,
    ENOUGH,
    FAR,
    FIRST,
    HELPERS,
    LEAST_REACH,
    LEAST_SCALING,
    LONG_PHASE,
    RESOLUTION,
    SCALING,
)
from diffpoint.kernels._backend import ti
from diffpoint.kernels.blocks import LANES

STOP, BID, MEASURE, MEASURE_START = 0, 1, 2, 3  # what the auction of a pair does next
# Columns of `shared`, each on a line of the cache of its own.
LEFT, ROUND, OVER = 0, 16, 32
# How often the thread of a pair looks for the scan of a helper before it scans itself, for every 16 objects.
PATIENCE = 8
MOST_IDLE = 2_000_000  # how often a helper looks for work in vain: bids from lists can go on for milliseconds


def build(real):
    RISE = RESOLUTION[4 if real == ti.f32 else 8] / 8  # the least increment of a price, relative to it
    persons3 = ti.types.ndarray(dtype=real, ndim=3)
    lanes2 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    scalars2 = ti.types.ndarray(dtype=real, ndim=2)
    tiles2 = ti.types.ndarray(dtype=ti.types.vector(LANES, ti.i32), ndim=2)
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
        def list_offers(
            persons: ti.template(),
            x_lanes: ti.template(),
            y_lanes: ti.template(),
            z_lanes: ti.template(),
            price_lanes: ti.template(),
            price: ti.template(),
            offer_tiles: ti.template(),
            offer_lanes: ti.template(),
            object_of_offer: ti.template(),
            offer_cost: ti.template(),
            rest: ti.template(),
            second_lanes: ti.template(),
            second_of: ti.template(),
            pair: ti.i32,
            person: ti.i32,
            n: ti.i32,
            target: ti.i32,
            worker: ti.i32,
        ):
            """Scans all objects for one person: the cheapest object of each lane at cost plus price, and its cost
            without price, become the list `target`; none of the other objects is cheaper than `rest`."""
            row = ti.min(person, n - 1)
            weight = ti.select(person < n, real(1.0), real(0.0))
            x = persons[pair, row, 0]
            y = persons[pair, row, 1]
            z = persons[pair, row, 2]
            first = ti.Vector([real(FAR) for s in ti.static(range(LANES))])
            second = ti.Vector([real(FAR) for s in ti.static(range(LANES))])
            tile = ti.Vector([0 for s in ti.static(range(LANES))])
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
                    tile[s] = ti.select(cheaper, t, tile[s])
                    first[s] = ti.select(cheaper, total[s], first[s])
            offer_tiles[pair, target] = tile
            offer_lanes[pair, target] = first
            # The least of these is found in memory: a reduction in registers would spoil how the scan is vectorised (3x
            # slower).
            second_lanes[pair, worker] = second
            least = real(FAR)
            # A loop, not unrolled: it costs little time, and unrolled it would take seconds to compile.
            best = real(FAR)
            for s in range(LANES):
                least = ti.min(least, second_of[pair, worker * LANES + s])
                entry = target * LANES + s
                object_of_offer[pair, entry] = object_of_offer[pair, entry] * LANES + s
                now = price[pair, object_of_offer[pair, entry]]
                cost = offer_cost[pair, entry] - now
                offer_cost[pair, entry] = cost
                best = ti.min(best, cost + now)
            rest[pair, target] = ti.max(least, best)  # `best` is rounded: a new list must be up to date

        @ti.func
        def best_of_list(
            price: ti.template(),
            object_of_offer: ti.template(),
            offer_cost: ti.template(),
            rest: ti.template(),
            pair: ti.i32,
            person: ti.i32,
        ):
            """The cheapest object of a person's list, its total, and a lower bound on the total of all others.

            As prices only rise, the list made at some time is good as long as its cheapest total is at most `rest`.
            """
            best = real(FAR)
            next_best = rest[pair, person]
            best_object = 0
            for s in range(LANES):
                j = object_of_offer[pair, person * LANES + s]
                total = offer_cost[pair, person * LANES + s] + price[pair, j]
                cheaper = total < best
                loser = ti.select(cheaper, best, total)
                next_best = ti.select(loser < next_best, loser, next_best)
                best_object = ti.select(cheaper, j, best_object)
                best = ti.select(cheaper, total, best)
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
            chosen: integers2,
            offer_tiles: tiles2,
            offer_lanes: lanes2,
            object_of_offer: integers2,
            offer_cost: scalars2,
            rest: scalars2,
            second_lanes: lanes2,
            second_of: scalars2,
            total_paid: scalars2,
            shared: integers2,
            scanned: integers2,
            bound: doubles1,
            finished: flags1,
            tolerance: ti.f64,
            resolution: ti.f64,
            bids_per_person: ti.i32,
            round_size: ti.i32,
            helpers: ti.i32,
            spread: ti.i32,
        ):
            """`price` and `price_lanes` are the same memory: first the prices to start from, at the end the final ones.
            So are `offer_tiles` and `object_of_offer`, `offer_lanes` and `offer_cost`, `second_lanes` and `second_of`.

            start_cost: the mean cost of the pair that the prices to start from belong to; negative if all prices are 0.
            enough: the auction stops once the lower bound of the optimal mean cost reaches this.
            bound: upper bound of the mean cost minus the optimum.
            shared, scanned: zeros; by these the thread of a pair and up to HELPERS helpers share out the scans of a
            round. The lists have `round_size` more entries for each helper, which leaves there what it finds.
            """
            for step in range((persons.shape[0] + helpers) * spread):
                if step % spread == 0 and step // spread >= persons.shape[0]:
                    # A helper scans for persons that the threads of the pairs have chosen, until these are done. All
                    # pairs are under way: iterations start in order.
                    helper = step // spread - persons.shape[0]
                    for pair in range(persons.shape[0]):
                        n = ti.cast(person_counts[pair], ti.i32)
                        over = 0
                        idle = 0
                        # It gives up where there is nothing to do for tens of milliseconds: the thread of the pair has
                        # lost its core, which this one must not keep busy.
                        while over == 0 and idle < MOST_IDLE:
                            idle += 1
                            # Atomic accesses are also barriers: the compiler reads memory anew after them.
                            over = ti.atomic_max(shared[pair, OVER], 0)
                            if shared[pair, LEFT] > 0:
                                now = ti.atomic_max(shared[pair, ROUND], 0)
                                k = ti.atomic_sub(shared[pair, LEFT], 1) - 1
                                if k >= 0:
                                    idle = 0
                                    list_offers(
                                        persons,
                                        x_lanes,
                                        y_lanes,
                                        z_lanes,
                                        price_lanes,
                                        price,
                                        offer_tiles,
                                        offer_lanes,
                                        object_of_offer,
                                        offer_cost,
                                        rest,
                                        second_lanes,
                                        second_of,
                                        pair,
                                        ti.min(chosen[pair, k], n),
                                        n,
                                        persons.shape[1] + helper * round_size + k,
                                        helper + 1,
                                    )
                                    # Of a round that has ended meanwhile nothing is used: prices may have changed.
                                    if ti.atomic_max(shared[pair, ROUND], 0) == now:
                                        ti.atomic_max(scanned[pair, k], now * HELPERS + helper)
                elif step % spread == 0:
                    pair = step // spread
                    n = ti.cast(person_counts[pair], ti.i32)
                    m = ti.cast(object_counts[pair], ti.i32)
                    # Higher prices than of any auction are of no use, and infinite ones would spoil the lists.
                    highest_price = largest_cost[pair] * real(1e3)
                    for j in range(price.shape[1]):
                        price[pair, j] = ti.select(j < m, ti.min(price[pair, j], highest_price), real(FAR))
                    for i in range(m):
                        object_of[pair, i] = -1
                        person_of[pair, i] = -1
                        queue[pair, i] = i
                        rest[pair, i] = -real(FAR)  # no list yet
                    coarsest = largest_cost[pair] * real(COARSEST)
                    # What distances and prices are compared with: increments below its resolution would be lost.
                    nothing = largest_cost[pair] * real(LEAST_REACH)
                    reach = nothing
                    epsilon = coarsest
                    proof_wanted = ti.cast(enough[pair], ti.f64) * n
                    best_lower_bound = ti.cast(-1.0, ti.f64)
                    bids = ti.cast(0, ti.i64)
                    bid_limit = ti.cast(bids_per_person, ti.i64) * ti.cast(m, ti.i64)
                    raise_at = ti.cast(LONG_PHASE, ti.i64) * ti.cast(m, ti.i64)
                    bound[pair] = 0.0
                    finished[pair] = ti.u8(1)
                    started = start_cost[pair] >= 0
                    now_open = 0  # the number of the round; that plus 1 while none is open
                    looked_at = 0
                    head = 0
                    waiting = m
                    stage = MEASURE_START
                    while stage != STOP:
                        # Whose list is out of date and needed?
                        count = 0
                        if stage == BID:
                            dummy_chosen = False
                            while waiting > 0 and count < round_size and bids < bid_limit:
                                i = queue[pair, head]
                                if i >= n and dummy_chosen:
                                    break
                                head = ti.select(head + 1 == m, 0, head + 1)
                                waiting -= 1
                                j, best, next_best = best_of_list(
                                    price, object_of_offer, offer_cost, rest, pair, ti.min(i, n)
                                )
                                if best > rest[pair, ti.min(i, n)]:
                                    chosen[pair, count] = i
                                    count += 1
                                    dummy_chosen = dummy_chosen or i >= n
                                else:
                                    # A single object has no second best offer, so its price rises by epsilon only.
                                    rise = ti.select(m > 1, next_best - best, real(0.0)) + epsilon
                                    now = price[pair, j]
                                    rise = ti.max(rise, now * real(RISE))  # never lost to rounding
                                    price[pair, j] = now + rise
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
                                    if bids == raise_at:
                                        # The first increment was too small for the pair.
                                        epsilon = ti.min(epsilon * real(SCALING * SCALING), coarsest)
                                        raise_at += ti.cast(LONG_PHASE, ti.i64) * ti.cast(m, ti.i64)
                            for k in range(count):  # back to the head of the queue, in order
                                at = head - count + k
                                queue[pair, ti.select(at < 0, at + m, at)] = chosen[pair, k]
                            head = ti.select(head < count, head - count + m, head - count)
                            waiting += count
                        else:
                            while looked_at < n and count < round_size:
                                _, best, _ = best_of_list(
                                    price, object_of_offer, offer_cost, rest, pair, looked_at
                                )
                                if best > rest[pair, looked_at]:
                                    chosen[pair, count] = looked_at
                                    count += 1
                                looked_at += 1

                        # Scan for them; first for those that no helper has claimed, then for those whose helper is
                        # late: it may have lost its core.
                        claiming = helpers > 0 and count > 0
                        own = ti.cast(0, ti.i64)
                        if claiming:
                            now_open += 2
                            ti.atomic_max(shared[pair, ROUND], now_open)
                            ti.atomic_max(shared[pair, LEFT], count)  # 0 or less before
                        left = count
                        while left > 0:
                            k = left - 1
                            needed_here = True
                            if claiming:
                                k = ti.atomic_sub(shared[pair, LEFT], 1) - 1
                                if k < 0:
                                    claiming = False
                                    needed_here = False
                                else:
                                    own |= ti.cast(1, ti.i64) << k
                            else:
                                left -= 1
                                if helpers > 0:
                                    needed_here = (own >> k) & 1 == 0
                                    patience = ti.select(needed_here, x_lanes.shape[1] * PATIENCE, 0)
                                    while patience > 0:
                                        patience -= 1
                                        by = ti.atomic_max(scanned[pair, k], 0)
                                        if by // HELPERS == now_open:
                                            source = persons.shape[1] + by % HELPERS * round_size + k
                                            target = ti.min(chosen[pair, k], n)
                                            for s in range(LANES):
                                                object_of_offer[pair, target * LANES + s] = object_of_offer[
                                                    pair, source * LANES + s
                                                ]
                                                offer_cost[pair, target * LANES + s] = offer_cost[
                                                    pair, source * LANES + s
                                                ]
                                            rest[pair, target] = rest[pair, source]
                                            patience = 0
                                            needed_here = False
                            if needed_here:
                                list_offers(
                                    persons,
                                    x_lanes,
                                    y_lanes,
                                    z_lanes,
                                    price_lanes,
                                    price,
                                    offer_tiles,
                                    offer_lanes,
                                    object_of_offer,
                                    offer_cost,
                                    rest,
                                    second_lanes,
                                    second_of,
                                    pair,
                                    ti.min(chosen[pair, k], n),
                                    n,
                                    ti.min(chosen[pair, k], n),
                                    0,
                                )
                        if helpers > 0 and count > 0:
                            ti.atomic_max(shared[pair, ROUND], now_open + 1)

                        if stage == BID:
                            if waiting == 0 or bids >= bid_limit:
                                stage = MEASURE
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
                        elif looked_at == n:
                            # All lists are up to date: measure.
                            looked_at = 0
                            lowest_price = real(FAR)
                            highest_price = real(0.0)
                            lower_bound = ti.cast(0.0, ti.f64)
                            cost = ti.cast(0.0, ti.f64)
                            for j in range(m):
                                now = price[pair, j]
                                lowest_price = ti.min(lowest_price, now)
                                highest_price = ti.max(highest_price, now)
                                lower_bound -= ti.cast(now, ti.f64)
                                i = person_of[pair, j]
                                if i >= 0 and i < n:
                                    dx = persons[pair, i, 0] - objects[pair, j, 0]
                                    dy = persons[pair, i, 1] - objects[pair, j, 1]
                                    dz = persons[pair, i, 2] - objects[pair, j, 2]
                                    paid = cost_of(dx, dy, dz)
                                    cost += ti.cast(paid, ti.f64)
                                    total_paid[pair, i] = paid + now
                            smallest_epsilon = ti.cast(
                                ti.cast(reach + highest_price, ti.f64) * resolution, real
                            )
                            finer = ti.max(epsilon / real(SCALING), smallest_epsilon)
                            needed = ti.cast(cost / n * tolerance * ENOUGH, real)
                            if needed < epsilon / real(LEAST_SCALING):
                                finer = ti.max(finer, needed)
                            dissatisfied = 0
                            for i in range(m):
                                cheapest = lowest_price  # for a dummy person
                                j = object_of[pair, i]
                                total = real(0.0)
                                if i < n:
                                    _, cheapest, _ = best_of_list(
                                        price, object_of_offer, offer_cost, rest, pair, i
                                    )
                                    total = total_paid[pair, i]
                                    if j < 0:
                                        reach = ti.max(reach, cheapest)
                                elif j >= 0:
                                    total = price[pair, j]
                                lower_bound += ti.cast(cheapest, ti.f64)
                                # A person within the next epsilon of the best offer keeps the object; the others bid.
                                if j >= 0 and total > cheapest + finer:
                                    queue[pair, dissatisfied] = i
                                    dissatisfied += 1
                            best_lower_bound = ti.max(best_lower_bound, lower_bound)
                            if stage == MEASURE:
                                gap = ti.max(cost - best_lower_bound, 0.0)
                                bound[pair] = gap / n
                                good = gap <= tolerance * cost or best_lower_bound >= proof_wanted
                                if good or finished[pair] == 0:
                                    stage = STOP
                                elif epsilon <= smallest_epsilon:
                                    # The resolution of the dtype is reached; the remaining gap is rounding unless it is
                                    # large.
                                    if gap / n > 10.0 * ti.cast(smallest_epsilon, ti.f64):
                                        finished[pair] = ti.u8(0)
                                    stage = STOP
                                else:
                                    stage = BID
                                    epsilon = finer
                                    raise_at = bid_limit + 1
                                    head = 0
                                    waiting = dissatisfied
                                    for q in range(waiting):
                                        i = queue[pair, q]
                                        person_of[pair, object_of[pair, i]] = -1
                                        object_of[pair, i] = -1
                            elif best_lower_bound >= proof_wanted:
                                # The start prices are enough (prices of 0 give the distance to the nearest object): any
                                # assignment.
                                stage = STOP
                                for i in range(m):
                                    object_of[pair, i] = i
                                    person_of[pair, i] = i
                                    if i < n:
                                        dx = persons[pair, i, 0] - objects[pair, i, 0]
                                        dy = persons[pair, i, 1] - objects[pair, i, 1]
                                        dz = persons[pair, i, 2] - objects[pair, i, 2]
                                        cost += ti.cast(cost_of(dx, dy, dz), ti.f64)
                                bound[pair] = ti.max(cost - best_lower_bound, 0.0) / n
                            else:
                                stage = BID
                                smallest_epsilon = ti.cast(
                                    ti.cast(reach + highest_price, ti.f64) * resolution, real
                                )
                                least = ti.cast(lower_bound / n, real)
                                epsilon = least * real(FIRST)
                                if started:
                                    # The lower bound from the start prices tells how well they fit this pair, and so
                                    # the first epsilon: the difference between the earlier cost and the bound is about
                                    # how far the pair has moved.
                                    known = ti.max(start_cost[pair], least)
                                    moved = ti.max(start_cost[pair] - least, least - start_cost[pair])
                                    epsilon = ti.max(known * ti.cast(tolerance * ENOUGH, real), moved)
                                    if not epsilon < coarsest:
                                        # They do not: measure again, without prices.
                                        stage = MEASURE_START
                                        started = False
                                        reach = nothing
                                        best_lower_bound = -1.0
                                        for j in range(m):
                                            price[pair, j] = 0.0
                                            rest[pair, j] = -real(FAR)
                                epsilon = ti.min(ti.max(epsilon, smallest_epsilon), coarsest)
                    if helpers > 0:
                        ti.atomic_max(shared[pair, OVER], 1)

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
