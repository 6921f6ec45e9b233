"""Numbers that every back end has to agree on; each stands here and nowhere else."""

# states of an occupancy cell; above OUTSIDE, how many half cells around it are certainly free
SHELL, SOLID, OUTSIDE = 0, 1, 2

FEATURES = 4  # per level of a hash grid, on the CPU: a row of a table is one vector register
HASH_PRIMES = (1, 2654435761, 805459861)  # along x, y, z (Müller et al. 2022, eq. 4)
FIRST_FEATURE_ROW = 4  # of what goes into the surface's network: x, y, z, 1, then features; columns of its weights alike

MAX_SAMPLES_PER_RAY = 96
STAGES = 6  # of these samples: in each but the first two the least slope is half of that before, or rays would run out along a surface
LONGEST_STEP = 0.25  # of the distance from the centre, in contracted space
LEAST_ADVANCE = 1.0 + 2.0**-22  # factor that a float32 moves on by at least: a short step far from a ray's origin may round to none
SOFT_SURFACE = 3.0  # times 1 / sharpness: how far from the surface a ray may not yet stride
FACE_OVERSHOOT = 0.1  # of a step, behind the face of a free cell
NO_CROSSING = 1e9  # distance to a face that a ray runs along; it does so below a velocity of ALONG_FACE
ALONG_FACE = 1e-9

LN2 = 0.6931471805599453  # -log Φ(0)
LAYER_GAP = 7.3  # times 1 / sharpness, in the frame of the grid: sections farther apart are of two surfaces (no multiple of a usual step)

HARMONICS = 16  # spherical harmonics up to degree 3
BLACK = 0.02  # of its modality's level: pixels that are darker say that nothing is there, where a scene is on black
MOSTLY_BLOCKED = 0.5  # opacity of a ray that does not only graze an edge
HUBER_DELTA = 0.5  # relative residuals above it count linearly
LEAST_ROUGHNESS = 0.02  # sharper images than any pixel could tell
REFRACTIVE_INDEX = 1.5  # of what mirrors lamps: glass, plastics, varnish
SOFT_EDGE = 0.3  # 1 - n·n' of two normals at half of the most that they are pulled together by: edges feel little of it
RAYS_OF_PAIR = 8  # at least, for each whose surface has a neighbour
LEAST_WEIGHT = 1e-12  # of a ray's sections, by which its features are divided

# of a ray's random numbers, what each decides
DRAW_TILE, DRAW_PIXEL, DRAW_JITTER = 0, 1, 2
PURPOSE_STRIDE = 0x9E3779B9  # between their keys
WORD = 32  # pixels whose bits are one number
