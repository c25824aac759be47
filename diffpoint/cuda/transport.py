"""Earth mover's distance on CUDA tensors: an auction in which several persons bid at once, one program per pair.

The method and its bound are those of `diffpoint.kernels.transport`. Two things differ:

- The first few of the waiting persons bid at the same prices (Bertsekas' Jacobi auction, in blocks). Of bids for one
  object the highest wins, and the others wait again. At the end of a phase, when hardly anyone waits, persons bid one
  by one, each at the prices that the one before has left, and all threads share a person's search.
- Dummy persons have no identity. They bid as a group: those that wait take the cheapest objects that dummies do not
  have yet, and all objects of dummies rise to the price of the cheapest one that is left, plus epsilon. No dummy is
  then more than epsilon above the cheapest object, which is all that the bound needs.

Prices, owners and the queue are in memory that all threads of a program read and write. A barrier stands between a load
of what any thread may change and the stores, and one after the stores.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _auction, _checks
from diffpoint.cuda import errors
from diffpoint.cuda.launch import bits_of, launch, real
from diffpoint.cuda.values import count_bad_sets

_WARPS = 8
_REGISTERS = {torch.float32: 128, torch.float64: None}  # in float32 two pairs share a multiprocessor
# Persons that bid at once, and objects examined at once: one per thread.
_PERSONS, _OBJECTS = tl.constexpr(8), tl.constexpr(256)
# Fewer waiting persons than this bid one after another, each with so many objects examined at once.
_FEW, _CHAIN = tl.constexpr(4), tl.constexpr(2048)
_LINE = tl.constexpr(1024)  # objects or persons at once elsewhere
_MEASURED = tl.constexpr(16)  # persons at once when the gap is measured
_FREE, _DUMMY = tl.constexpr(-1), tl.constexpr(-2)  # owners
_FAR = tl.constexpr(_auction.FAR)  # no price exceeds it
_LARGEST, _SMALLEST = tl.constexpr(_auction.LARGEST_COST), tl.constexpr(_auction.SMALLEST_COST)
_SCALING = tl.constexpr(_auction.SCALING)
_COARSEST = tl.constexpr(_auction.COARSEST)
_ENOUGH = tl.constexpr(_auction.ENOUGH)
_NOBODY = tl.constexpr(2147483647)


@triton.jit
def _order(x):
    """Integers in the order of numbers that are at least 0; NaN comes last. Threads compare integers faster."""
    return x.to(tl.int32 if x.dtype == tl.float32 else tl.int64, bitcast=True)


@triton.jit
def _number(order, like: tl.constexpr):
    """The number of `_order`."""
    return order.to(like, bitcast=True)


@triton.jit
def _root(x):
    """The correctly rounded square root, unlike `tl.sqrt` of float32."""
    return tl.sqrt_rn(x) if x.dtype == tl.float32 else tl.sqrt(x)


@triton.jit
def _sum_of_squares(x, y, z):
    return tl.fma(x, x, tl.fma(y, y, z * z))


@triton.jit
def _cost(dx, dy, dz, SQUARED: tl.constexpr):
    """Of matching two points with this difference, rounded as on the CPU."""
    squares = _sum_of_squares(dx, dy, dz)
    return squares if SQUARED else _root(squares)


@triton.jit
def _totals(x, y, z, objects, price, j, width, SQUARED: tl.constexpr):
    """Cost plus price of a tile of objects, for persons at (P, 1) coordinates."""
    dx = tl.load(objects + j)[None, :] - x
    dy = tl.load(objects + width + j)[None, :] - y
    dz = tl.load(objects + 2 * width + j)[None, :] - z
    squares = _sum_of_squares(dx, dy, dz)
    return (squares if SQUARED else tl.sqrt(squares)) + tl.load(price + j)[None, :]


@triton.jit
def _two_cheapest(
    persons, i, objects, price, m, width,
    SQUARED: tl.constexpr, PERSONS: tl.constexpr, OBJECTS: tl.constexpr,
):  # fmt: skip
    """For each person the lowest total, the second lowest, and the object of the lowest. Each lane keeps the two
    cheapest of its own objects, so that the loop has no reduction; the lanes are compared at the end."""
    x = tl.load(persons + i * 3)[:, None]
    y = tl.load(persons + i * 3 + 1)[:, None]
    z = tl.load(persons + i * 3 + 2)[:, None]
    lane = tl.arange(0, OBJECTS)
    first = tl.full((PERSONS, OBJECTS), float("inf"), price.dtype.element_ty)
    second = tl.full((PERSONS, OBJECTS), float("inf"), price.dtype.element_ty)
    tile = tl.zeros((PERSONS, OBJECTS), tl.int32)
    for start in range(0, m, OBJECTS):
        total = _totals(x, y, z, objects, price, start + lane, width, SQUARED)
        second = tl.minimum(second, tl.maximum(first, total))
        tile = tl.where(total < first, start, tile)
        first = tl.minimum(first, total)
    order = _order(first)
    best = tl.min(order, axis=1)
    candidate = tile + lane[None, :]
    j = tl.min(tl.where(order == best[:, None], candidate, _NOBODY), axis=1)
    next_best = tl.min(tl.where(candidate == j[:, None], _order(second), order), axis=1)
    return _number(best, first.dtype), _number(next_best, first.dtype), j


@triton.jit
def _offers(
    persons, i, objects, price, m, width, epsilon,
    SQUARED: tl.constexpr, PERSONS: tl.constexpr, OBJECTS: tl.constexpr,
):  # fmt: skip
    """For each person the object that is best for it, and the price that it bids."""
    best, next_best, j = _two_cheapest(persons, i, objects, price, m, width, SQUARED, PERSONS, OBJECTS)
    # A single object has no second best offer, so its price rises by epsilon only.
    return j, tl.load(price + j) + (tl.where(m > 1, next_best - best, 0.0) + epsilon)


@triton.jit
def _bid_at_once(
    persons, objects, price, owner, partner, queue, head, waiting, dummies, m, width, epsilon,
    SQUARED: tl.constexpr, PERSONS: tl.constexpr, OBJECTS: tl.constexpr,
):  # fmt: skip
    """The first persons of the queue bid. Returns its new head and length, and the number of waiting dummies."""
    rank = tl.arange(0, PERSONS)
    count = tl.minimum(waiting, PERSONS)
    live = rank < count
    i = tl.load(queue + ((head + rank) & (width - 1)), mask=live, other=0)
    j, offer = _offers(persons, i, objects, price, m, width, epsilon, SQUARED, PERSONS, OBJECTS)
    previous = tl.load(owner + j)
    # The highest of the offers for an object wins, the earliest of equal ones.
    higher = (offer[None, :] > offer[:, None]) | (
        (offer[None, :] == offer[:, None]) & (rank[None, :] < rank[:, None])
    )
    beaten = higher & (j[None, :] == j[:, None]) & live[None, :]
    lost = live & (tl.max(beaten.to(tl.int32), axis=1) > 0)
    won = live & (lost == 0)
    evicted = won & (previous >= 0)
    back = lost | evicted
    slot = head + waiting + tl.cumsum(back.to(tl.int32), axis=0) - 1
    tl.debug_barrier()
    tl.store(price + j, offer, mask=won)
    tl.store(owner + j, i, mask=won)
    tl.store(partner + i, j, mask=won)
    tl.store(partner + previous, -1, mask=evicted)
    tl.store(queue + (slot & (width - 1)), tl.where(lost, i, previous), mask=back)
    tl.debug_barrier()
    waiting += tl.sum(back.to(tl.int32), axis=0) - count
    dummies += tl.sum((won & (previous == _DUMMY)).to(tl.int32), axis=0)
    return (head + count) & (width - 1), waiting, dummies


@triton.jit
def _bid_in_a_chain(
    persons, objects, price, owner, partner, queue, head, waiting, dummies, bids, limit, m, width, epsilon,
    SQUARED: tl.constexpr, OBJECTS: tl.constexpr,
):  # fmt: skip
    """The first person of the queue bids, then who loses the object to it, and so on up to an object that no person
    has. Returns what `_bid_at_once` does, and the number of bids."""
    i = tl.load(queue + (head & (width - 1)))
    head = (head + 1) & (width - 1)
    waiting -= 1
    while (i >= 0) & (bids < limit):
        objects_of, offers = _offers(
            persons, tl.full((1,), 0, tl.int32) + i, objects, price, m, width, epsilon, SQUARED, 1, OBJECTS
        )
        j = tl.sum(objects_of, axis=0)
        offer = tl.sum(offers, axis=0)
        previous = tl.load(owner + j)
        tl.debug_barrier()
        tl.store(price + j, offer)
        tl.store(owner + j, i)
        tl.store(partner + i, j)
        tl.store(partner + previous, -1, mask=previous >= 0)
        tl.debug_barrier()
        dummies += (previous == _DUMMY).to(tl.int32)
        i = previous
        bids += 1
    if i >= 0:
        tl.store(queue + ((head + waiting) & (width - 1)), i)
        waiting += 1
    tl.debug_barrier()
    return head, waiting, dummies, bids


@triton.jit
def _place_dummies(price, owner, partner, queue, dummies, m, epsilon, LINE: tl.constexpr):
    """Places all waiting dummies while no person waits. Returns how many persons lose their object: a new queue."""
    lane = tl.arange(0, LINE)
    # The price of the cheapest object that is left: of those without a dummy, the one after as many as dummies wait.
    highest = tl.zeros((LINE,), price.dtype.element_ty)
    for start in range(0, m, LINE):
        j = start + lane
        other = (tl.load(owner + j) != _DUMMY) & (j < m)
        highest = tl.maximum(highest, tl.load(price + j, mask=other, other=0.0))
    high = tl.max(_order(highest), axis=0)
    low = high - high
    while low < high:
        middle = low + (high - low) // 2
        count = tl.zeros((LINE,), tl.int32)
        for start in range(0, m, LINE):
            j = start + lane
            other = (tl.load(owner + j) != _DUMMY) & (j < m)
            count += (other & (_order(tl.load(price + j)) <= middle)).to(tl.int32)
        if tl.sum(count, axis=0) > dummies:
            high = middle
        else:
            low = middle + 1
    cheaper = tl.zeros((LINE,), tl.int32)
    for start in range(0, m, LINE):
        j = start + lane
        other = (tl.load(owner + j) != _DUMMY) & (j < m)
        cheaper += (other & (_order(tl.load(price + j)) < low)).to(tl.int32)
    of_equals = dummies - tl.sum(cheaper, axis=0)
    level = _number(low, price.dtype.element_ty) + epsilon
    equals = 0
    waiting = 0
    for start in range(0, m, LINE):
        j = start + lane
        before = tl.load(owner + j)
        now = tl.load(price + j)
        other = (before != _DUMMY) & (j < m)
        equal = other & (_order(now) == low)
        rank = equals + tl.cumsum(equal.to(tl.int32), axis=0)
        taken = (other & (_order(now) < low)) | (equal & (rank <= of_equals))
        evicted = taken & (before >= 0)
        slot = waiting + tl.cumsum(evicted.to(tl.int32), axis=0) - 1
        tl.debug_barrier()
        tl.store(price + j, tl.maximum(now, level), mask=taken | (before == _DUMMY))
        tl.store(owner + j, _DUMMY, mask=taken)
        tl.store(partner + before, -1, mask=evicted)
        tl.store(queue + slot, before, mask=evicted)
        equals += tl.sum(equal.to(tl.int32), axis=0)
        waiting += tl.sum(evicted.to(tl.int32), axis=0)
    tl.debug_barrier()
    return waiting


@triton.jit
def _measure(
    persons, objects, price, partner, queue, n, m, width, finer,
    SQUARED: tl.constexpr, PERSONS: tl.constexpr, OBJECTS: tl.constexpr, LINE: tl.constexpr,
):  # fmt: skip
    """The lower bound of the cost that the prices give, the lowest price, the cost, and the length of the queue: of the
    persons with an offer better than what they have by more than `finer`."""
    lane = tl.arange(0, LINE)
    least = tl.full((LINE,), float("inf"), price.dtype.element_ty)
    prices = tl.zeros((LINE,), tl.float64)
    for start in range(0, m, LINE):
        now = tl.load(price + start + lane)
        least = tl.minimum(least, now)
        prices += tl.where(start + lane < m, now, 0.0).to(tl.float64)
    lowest = _number(tl.min(_order(least), axis=0), price.dtype.element_ty)
    bounds = tl.zeros((PERSONS,), tl.float64)
    costs = tl.zeros((PERSONS,), tl.float64)
    waiting = 0
    for start in range(0, n, PERSONS):
        i = start + tl.arange(0, PERSONS)
        inside = i < n
        x = tl.load(persons + i * 3, mask=inside, other=0.0)
        y = tl.load(persons + i * 3 + 1, mask=inside, other=0.0)
        z = tl.load(persons + i * 3 + 2, mask=inside, other=0.0)
        first = tl.full((PERSONS, OBJECTS), float("inf"), price.dtype.element_ty)
        for begin in range(0, m, OBJECTS):
            tile = begin + tl.arange(0, OBJECTS)
            total = _totals(x[:, None], y[:, None], z[:, None], objects, price, tile, width, SQUARED)
            first = tl.minimum(first, total)
        cheapest = _number(tl.min(_order(first), axis=1), first.dtype)
        bounds += tl.where(inside, cheapest, 0.0).to(tl.float64)
        j = tl.load(partner + i, mask=inside, other=-1)
        placed = j >= 0
        dx = tl.load(objects + j, mask=placed, other=0.0) - x
        dy = tl.load(objects + width + j, mask=placed, other=0.0) - y
        dz = tl.load(objects + 2 * width + j, mask=placed, other=0.0) - z
        paid = _cost(dx, dy, dz, SQUARED)
        costs += tl.where(placed, paid, 0.0).to(tl.float64)
        paid += tl.load(price + j, mask=placed, other=0.0)
        unhappy = placed & (paid > cheapest + finer)
        slot = waiting + tl.cumsum(unhappy.to(tl.int32), axis=0) - 1
        tl.store(queue + slot, i, mask=unhappy)
        waiting += tl.sum(unhappy.to(tl.int32), axis=0)
    tl.debug_barrier()
    of_dummies = (m - n).to(tl.float64) * lowest.to(tl.float64)
    bound = tl.sum(bounds, axis=0) + of_dummies - tl.sum(prices, axis=0)
    return bound, lowest, tl.sum(costs, axis=0), waiting


@triton.jit
def _release(price, owner, partner, queue, waiting, m, highest, LINE: tl.constexpr):
    """Takes the objects from the persons in the queue, and from the dummies above a price. Returns their number."""
    lane = tl.arange(0, LINE)
    for start in range(0, waiting, LINE):
        inside = start + lane < waiting
        i = tl.load(queue + start + lane, mask=inside, other=0)
        j = tl.load(partner + i, mask=inside, other=0)
        tl.debug_barrier()
        tl.store(owner + j, _FREE, mask=inside)
        tl.store(partner + i, -1, mask=inside)
    tl.debug_barrier()
    count = tl.zeros((LINE,), tl.int32)
    for start in range(0, m, LINE):
        j = start + lane
        leaves = (tl.load(owner + j) == _DUMMY) & (tl.load(price + j) > highest)
        tl.debug_barrier()
        tl.store(owner + j, _FREE, mask=leaves)
        count += leaves.to(tl.int32)
    tl.debug_barrier()
    return tl.sum(count, axis=0)


@triton.jit
def _assign_the_rest(owner, partner, free, n, m, LINE: tl.constexpr):
    """Persons without an object take free objects in order; `free` is memory for a list of these."""
    lane = tl.arange(0, LINE)
    count = 0
    for start in range(0, m, LINE):
        j = start + lane
        is_free = (tl.load(owner + j) == _FREE) & (j < m)
        slot = count + tl.cumsum(is_free.to(tl.int32), axis=0) - 1
        tl.store(free + slot, j, mask=is_free)
        count += tl.sum(is_free.to(tl.int32), axis=0)
    tl.debug_barrier()
    count = 0
    for start in range(0, n, LINE):
        i = start + lane
        alone = (tl.load(partner + i) < 0) & (i < n)
        slot = count + tl.cumsum(alone.to(tl.int32), axis=0) - 1
        j = tl.load(free + slot, mask=alone, other=0)
        tl.debug_barrier()
        tl.store(partner + i, j, mask=alone)
        tl.store(owner + j, i, mask=alone)
        count += tl.sum(alone.to(tl.int32), axis=0)
    tl.debug_barrier()


@triton.jit
def _box(persons, others, n, m, LINE: tl.constexpr):
    """The diagonal of the bounding box of two sets, in float64, and how many points are not finite and left out."""
    lane = tl.arange(0, LINE)
    infinite = float("inf")
    lx = tl.full((LINE,), infinite, persons.dtype.element_ty)
    ly = tl.full((LINE,), infinite, persons.dtype.element_ty)
    lz = tl.full((LINE,), infinite, persons.dtype.element_ty)
    hx, hy, hz = -lx, -ly, -lz
    bad = tl.zeros((LINE,), tl.int32)
    points = persons
    count = n
    for _ in range(2):
        for start in range(0, count, LINE):
            inside = start + lane < count
            at = (start + lane) * 3
            x = tl.load(points + at, mask=inside, other=0.0)
            y = tl.load(points + at + 1, mask=inside, other=0.0)
            z = tl.load(points + at + 2, mask=inside, other=0.0)
            finite = (tl.abs(x) < infinite) & (tl.abs(y) < infinite) & (tl.abs(z) < infinite)
            bad += (finite == 0).to(tl.int32)
            good = inside & finite
            lx = tl.where(good & (x < lx), x, lx)
            ly = tl.where(good & (y < ly), y, ly)
            lz = tl.where(good & (z < lz), z, lz)
            hx = tl.where(good & (x > hx), x, hx)
            hy = tl.where(good & (y > hy), y, hy)
            hz = tl.where(good & (z > hz), z, hz)
        points = others
        count = m
    dx = tl.max(hx, axis=0).to(tl.float64) - tl.min(lx, axis=0).to(tl.float64)
    dy = tl.max(hy, axis=0).to(tl.float64) - tl.min(ly, axis=0).to(tl.float64)
    dz = tl.max(hz, axis=0).to(tl.float64) - tl.min(lz, axis=0).to(tl.float64)
    return tl.sqrt(dx * dx + dy * dy + dz * dz), tl.sum(bad, axis=0)


@triton.jit(
    do_not_specialize=[
        "size_a", "size_b", "width", "tolerance_bits", "resolution_bits", "bids_per_person",
    ],
    do_not_specialize_on_alignment=["bad_price", "bad_cost", "too_wide"],
)  # fmt: skip
def _match(
    a, b, a_lengths, b_lengths, start_prices, start_costs, enoughs,
    costs, assignments, bounds, finished_flags, prices, reals, integers, bad_price, bad_cost, too_wide,
    size_a, size_b, width, tolerance_bits, resolution_bits, bids_per_person,
    SQUARED: tl.constexpr,
):  # fmt: skip
    """One pair. `reals` and `integers` hold 4 x `width` numbers for each, `width` a power of two."""
    row = tl.program_id(0).to(tl.int64)
    dtype: tl.constexpr = a.dtype.element_ty
    lane = tl.arange(0, _LINE)
    size = tl.maximum(size_a, size_b)
    length_a = tl.minimum(tl.maximum(tl.load(a_lengths + row), 0), size_a).to(tl.int32)
    length_b = tl.minimum(tl.maximum(tl.load(b_lengths + row), 0), size_b).to(tl.int32)
    # The points of the smaller set are the bidders ("persons"), those of the larger set the objects.
    n = tl.minimum(length_a, length_b)
    m = tl.maximum(length_a, length_b)
    swap = length_a > length_b
    persons = a + row * size_a * 3
    others = b + row * size_b * 3
    if swap:
        persons = b + row * size_b * 3
        others = a + row * size_a * 3
    objects = reals + row * 4 * width
    price = objects + 3 * width
    owner = integers + row * 4 * width
    partner = owner + width
    queue = owner + 2 * width
    tolerance = real(tolerance_bits, tl.float64)

    diagonal, bad = _box(persons, others, n, m, _LINE)
    largest = diagonal * diagonal if SQUARED else diagonal
    usable = (n > 0) & (bad == 0)
    if usable & (largest >= _LARGEST):
        tl.atomic_add(too_wide, 1)
    usable = usable & (largest < _LARGEST)
    largest_cost = tl.minimum(tl.maximum(largest, _SMALLEST), _LARGEST).to(dtype)
    smallest_epsilon = (largest_cost.to(tl.float64) * real(resolution_bits, tl.float64)).to(dtype)
    coarsest = tl.maximum(largest_cost * _COARSEST, smallest_epsilon)

    # Only differences between prices matter; without this they would grow from start to start.
    start_prices += row * size
    least = tl.full((_LINE,), float("inf"), dtype)
    wrong = tl.zeros((_LINE,), tl.int32)
    for start in range(0, size, _LINE):
        j = start + lane
        given = tl.load(start_prices + j, mask=j < size, other=0.0)
        finite = tl.abs(given) < float("inf")
        wrong += (finite == 0).to(tl.int32)
        least = tl.where((j < m) & finite & (given < least), given, least)
    lowest = tl.min(least, axis=0)
    if tl.sum(wrong, axis=0) > 0:
        tl.atomic_add(bad_price, tl.sum(wrong, axis=0))
    for start in range(0, width, _LINE):
        j = start + lane
        inside = j < m
        tl.store(objects + j, tl.load(others + j * 3, mask=inside, other=0.0))
        tl.store(objects + width + j, tl.load(others + j * 3 + 1, mask=inside, other=0.0))
        tl.store(objects + 2 * width + j, tl.load(others + j * 3 + 2, mask=inside, other=0.0))
        given = tl.load(start_prices + j, mask=inside, other=0.0)
        given = tl.where(tl.abs(given) < float("inf"), given - lowest, 0.0)
        tl.store(price + j, tl.where(inside, tl.minimum(given, _FAR), float("inf")))
        tl.store(owner + j, tl.full((_LINE,), _FREE, tl.int32))
        tl.store(partner + j, tl.full((_LINE,), -1, tl.int32))
        tl.store(queue + j, j)
    tl.debug_barrier()

    start_cost = tl.load(start_costs + row)
    if (tl.abs(start_cost) < float("inf")) == 0:
        tl.atomic_add(bad_cost, 1)
    started = (start_cost >= 0) & (start_cost < float("inf"))
    enough = tl.load(enoughs + row)
    proof_wanted = enough.to(tl.float64) * n
    tries = tl.where(started | (enough < _FAR), 0, 1)  # 0: the start prices are measured, and nobody bids yet
    epsilon = coarsest
    best_bound = tl.full((), -1.0, tl.float64)
    cost = tl.full((), float("nan"), tl.float64)
    gap = tl.full((), float("nan"), tl.float64)
    head = 0
    waiting = n
    dummies = m - n
    bids = tl.zeros((), tl.int64)
    limit = m.to(tl.int64) * bids_per_person
    finished = usable
    running = usable
    while running:
        finer = tl.maximum(epsilon / _SCALING, smallest_epsilon)
        if tries == 0:
            finer = tl.full((), float("inf"), dtype)  # nobody has an object
        else:
            while ((waiting > 0) | (dummies > 0)) & (bids < limit):
                if waiting >= _FEW:
                    bids += tl.minimum(waiting, _PERSONS)
                    head, waiting, dummies = _bid_at_once(
                        persons, objects, price, owner, partner, queue, head, waiting, dummies, m, width, epsilon,
                        SQUARED, _PERSONS, _OBJECTS,
                    )  # fmt: skip
                elif waiting > 0:
                    head, waiting, dummies, bids = _bid_in_a_chain(
                        persons, objects, price, owner, partner, queue, head, waiting, dummies, bids, limit, m, width,
                        epsilon, SQUARED, _CHAIN,
                    )  # fmt: skip
                else:
                    bids += dummies
                    head = 0
                    waiting = _place_dummies(price, owner, partner, queue, dummies, m, epsilon, _LINE)
                    dummies = 0
            if (waiting > 0) | (dummies > 0):
                _assign_the_rest(owner, partner, queue, n, m, _LINE)
                finished = best_bound >= proof_wanted
        bound, lowest, cost, waiting = _measure(
            persons, objects, price, partner, queue, n, m, width, finer, SQUARED, _MEASURED, _OBJECTS, _LINE
        )
        best_bound = tl.maximum(best_bound, bound)
        gap = tl.maximum(cost - best_bound, 0.0)
        if tries == 0:
            waiting = n
            if best_bound >= proof_wanted:
                # The start prices are enough (prices of 0 give the distance to the nearest object): any assignment.
                limit = tl.zeros((), tl.int64)
            elif started:
                # The lower bound from the start prices tells how well they fit this pair, and so the first epsilon: the
                # difference between the earlier cost and the bound is about how far the pair has moved.
                bound_then = (bound / n).to(dtype)
                known = tl.maximum(start_cost, bound_then) * (tolerance * _ENOUGH).to(dtype)
                moved = tl.abs(start_cost - bound_then)
                epsilon = tl.maximum(known, tl.maximum(moved, smallest_epsilon))
                if (epsilon < coarsest) == 0:
                    epsilon = coarsest
                    for start in range(0, m, _LINE):
                        tl.store(price + start + lane, tl.zeros((_LINE,), dtype), mask=start + lane < m)
                    tl.debug_barrier()
        elif (gap <= tolerance * cost) | (best_bound >= proof_wanted) | (finished == 0):
            running = False
        elif epsilon <= smallest_epsilon:
            # The resolution of the dtype is reached; the remaining gap is rounding unless it is large.
            finished = gap / n <= 10.0 * smallest_epsilon.to(tl.float64)
            running = False
        else:
            epsilon = finer
            head = 0
            dummies = _release(price, owner, partner, queue, waiting, m, lowest + finer, _LINE)
        tries += 1

    tl.store(costs + row, (cost / n).to(dtype))
    tl.store(bounds + row, (gap / n).to(dtype))
    tl.store(finished_flags + row, finished.to(tl.uint8))
    least = tl.full((_LINE,), float("inf"), dtype)
    for start in range(0, m, _LINE):
        least = tl.minimum(least, tl.load(price + start + lane))
    lowest = tl.min(least, axis=0)
    for start in range(0, size, _LINE):
        j = start + lane
        now = tl.load(price + j, mask=j < m, other=0.0)
        tl.store(prices + row * size + j, tl.where(j < m, now - lowest, 0.0), mask=j < size)
    matched = partner
    if swap:
        matched = owner
    for start in range(0, size_a, _LINE):
        i = start + lane
        j = tl.maximum(tl.load(matched + i), -1)
        tl.store(assignments + row * size_a + i, j.to(tl.int64), mask=i < size_a)


@triton.jit
def _gradient(
    a, b, assignment, grad_mean, grad_a, grad_b, size_a, size_b,
    SQUARED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A tile of `a`. No two points have one partner, so that the stores to `grad_b` do not collide."""
    tiles = tl.cdiv(size_a, BLOCK)
    row = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * BLOCK + tl.arange(0, BLOCK)
    inside = i < size_a
    j = tl.load(assignment + row * size_a + i, mask=inside, other=-1)
    matched = (j >= 0) & (j < size_b)
    at_a = (row * size_a + i) * 3
    at_b = (row * size_b + j) * 3
    dx = tl.load(a + at_a, mask=matched, other=0.0) - tl.load(b + at_b, mask=matched, other=0.0)
    dy = tl.load(a + at_a + 1, mask=matched, other=0.0) - tl.load(b + at_b + 1, mask=matched, other=0.0)
    dz = tl.load(a + at_a + 2, mask=matched, other=0.0) - tl.load(b + at_b + 2, mask=matched, other=0.0)
    grad = tl.load(grad_mean + row)
    if SQUARED:
        scale = tl.where(matched, 2 * grad, 0.0)
    else:
        distance = _root(dx * dx + dy * dy + dz * dz)
        apart = distance > 0
        scale = tl.where(apart, grad / tl.where(apart, distance, 1.0), 0.0)
    tl.store(grad_a + at_a, dx * scale, mask=inside)
    tl.store(grad_a + at_a + 1, dy * scale, mask=inside)
    tl.store(grad_a + at_a + 2, dz * scale, mask=inside)
    tl.store(grad_b + at_b, -dx * scale, mask=matched)
    tl.store(grad_b + at_b + 1, -dy * scale, mask=matched)
    tl.store(grad_b + at_b + 2, -dz * scale, mask=matched)


def earth_mover_distance(
    a: Tensor,
    b: Tensor,
    a_lengths: Tensor,
    b_lengths: Tensor,
    prices: Tensor,
    known_cost: Tensor,
    enough: Tensor,
    tolerance: float,
    squared: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """As the operator."""
    name = "earth_mover_distance"
    count, size_a, size_b = a.shape[0], a.shape[1], b.shape[1]
    cost, bound = a.new_empty(count), a.new_empty(count)
    assignment = a_lengths.new_empty((count, size_a))
    finished = torch.empty(count, dtype=torch.uint8, device=a.device)
    final_prices = torch.empty_like(prices)
    count_bad_sets(name, a, b, a_lengths, b_lengths, smallest=1)
    if count:
        width = max(_CHAIN.value, triton.next_power_of_2(max(size_a, size_b)))
        extent = "extent of squares" if squared else "extent"
        counters = (("start.prices", "finite"), ("start.cost", "finite"), ("a", extent))
        launch(
            _match, count, a, b, a_lengths, b_lengths, prices, known_cost, enough,
            cost, assignment, bound, finished, final_prices,
            a.new_empty((count, 4, width)), a_lengths.new_empty((count, 4, width), dtype=torch.int32),
            *(errors.counter(a, name, argument, kind) for argument, kind in counters),
            size_a, size_b, width,
            bits_of(tolerance), bits_of(_auction.RESOLUTION[a.dtype.itemsize]), _auction.BIDS_PER_PERSON,
            squared, warps=_WARPS, registers=_REGISTERS[a.dtype],
        )  # fmt: skip
    errors.settle(a, lambda: _checks.check_transport(a, b, a_lengths, b_lengths, prices, known_cost, squared))
    return cost, assignment, bound, finished.view(torch.bool), final_prices


def earth_mover_distance_backward(
    a: Tensor, b: Tensor, assignment: Tensor, grad_mean: Tensor, squared: bool
) -> tuple[Tensor, Tensor]:
    """As the operator."""
    grad_a, grad_b = torch.zeros_like(a), torch.zeros_like(b)
    if a.numel() and b.numel():
        block = 256
        programs = a.shape[0] * triton.cdiv(a.shape[1], block)
        sizes = a.shape[1], b.shape[1]
        launch(_gradient, programs, a, b, assignment, grad_mean, grad_a, grad_b, *sizes, squared, block)
    return grad_a, grad_b
