"""The schedule of the auction for the earth mover's distance, which the kernels for CPU and CUDA share."""

SCALING = 5.0  # factor of the bid increment (epsilon) between phases
COARSEST = 0.1  # first epsilon, relative to the extent of the pair
# The smallest epsilon, relative to the accepted gap: a phase leaves a mean gap of 0.4 to 0.6 epsilon.
ENOUGH = 1.5
# Limit on the bids of a pair, per point of its larger set; after it the remaining points are matched in order.
BIDS_PER_PERSON = 4000
# Beyond this extent squares and prices overflow in float32, and prices exceed that of the padding.
LARGEST_EXTENT = 1e18
FAR = 1e30  # price of padding
# The smallest bid increment, relative to the extent of the pair: the resolution of prices of so many bytes.
RESOLUTION = {4: 2e-6, 8: 1e-12}
