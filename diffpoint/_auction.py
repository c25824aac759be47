"""The schedule of the auction for the earth mover's distance, which the kernels for CPU and CUDA share."""

SCALING = 5.0  # factor of the bid increment (epsilon) between phases
LEAST_SCALING = 1.5  # the least on the CPU, where a factor below the usual one gives the accuracy asked for
COARSEST = 0.1  # first epsilon, relative to the largest cost that the extent of the pair allows
# First epsilon on the CPU, relative to the lower bound of the mean cost that prices of 0 give.
FIRST = 1.0
# A first phase of more bids than this per point of the larger set has too small an epsilon, which is raised.
LONG_PHASE = 20
# Threads that help with one pair on the CPU, at most.
HELPERS = 7
# What distances and prices are taken for, relative to the largest cost of the pair, if they are less.
LEAST_REACH = 1e-2
# The smallest epsilon, relative to the accepted gap: a phase leaves a mean gap of 0.4 to 0.6 epsilon.
ENOUGH = 1.5
# Limit on the bids of a pair, per point of its larger set; after it the remaining points are matched in order.
BIDS_PER_PERSON = 4000
# Costs beyond this, and prices, which may exceed them, come near that of the padding. In float32, squares overflow.
LARGEST_COST = 1e18
# What the largest cost of a pair is taken for if it is less: increments relative to it stay normal numbers of float32.
SMALLEST_COST = 1e-30
FAR = 1e30  # price of padding
# The smallest bid increment, relative to the largest cost of the pair: the resolution of prices of so many bytes.
RESOLUTION = {4: 2e-6, 8: 1e-12}
