// SPDX-License-Identifier: Apache-2.0
// SURF-128 on a GPU: the descriptors of surf_descriptor.py and surf_pair.py, one group of GROUP items per keypoint.
//
// Compiled after surf_detector.cl, whose `real` it takes. In double precision wavelets are summed as on the CPU, rounding
// included: the sign of one that is zero but for rounding decides what another counts for. In single precision sums are
// taken from the keypoint's own pixel, less the mean grey value around it, so that the numbers stay small; wavelets are
// differences that neither changes.

#define TURNED_NODES (TURNED_CORNERS - 2)
#define DISC_SIDE (2 * DISC_RADIUS + 1)
#define WINDOW (DIRECTIONS / 6)

// The corners around a keypoint: `left`, `top` are those of the first one relative to the pixel (column, row).
typedef struct {
    int column, row, width, height, grey;
    real left, top, step;
} Square;

Square square_around(global const uint *sums, int width, int height, global const float *place, int corners, float step)
{
    Square s = {.width = width, .height = height, .step = (real)step * place[2]};
    const real reach = (real)0.5f * (corners - 1) * s.step;
#if !DOUBLE
    s.column = clamp((int)floor(place[0]), 0, width - 1), s.row = clamp((int)floor(place[1]), 0, height - 1);
    const int x0 = max(s.column - (int)reach, 0), x1 = min(s.column + (int)reach + 1, width);
    const int y0 = max(s.row - (int)reach, 0), y1 = min(s.row + (int)reach + 1, height);
    s.grey = box(sums, width + 1, x0, y0, x1, y1) / ((x1 - x0) * (y1 - y0));
#endif
    s.left = (place[0] - s.column) + (real)0.5f - reach, s.top = (place[1] - s.row) + (real)0.5f - reach;
    return s;
}

// Sum, less `grey` per pixel, over the pixels between the square's own pixel and a corner (x, y) of pixels.
real sum_to(global const uint *sums, const Square *s, int x, int y)
{
    return (real)(box(sums, s->width + 1, s->column, s->row, x, y) - s->grey * (x - s->column) * (y - s->row));
}

// The integral image at all corners, bilinear. What lies beyond the image's edge is a number without a meaning.
void read_lattice(global const uint *sums, const Square *s, int corners, local real *lattice)
{
    for (int k = get_local_id(0); k < corners * corners; k += GROUP) {
        const real x = s->left + (k % corners) * s->step, y = s->top + (k / corners) * s->step;
        const int x0 = clamp(s->column + (int)floor(x), 0, s->width - 1);
        const int y0 = clamp(s->row + (int)floor(y), 0, s->height - 1);
        const real share_x = x - (x0 - s->column), share_y = y - (y0 - s->row);
        const real a = sum_to(sums, s, x0, y0), b = sum_to(sums, s, x0, y0 + 1);
        const real c = sum_to(sums, s, x0 + 1, y0), d = sum_to(sums, s, x0 + 1, y0 + 1);
        const real first = a + share_y * (b - a), second = c + share_y * (d - c);
        lattice[k] = first + share_x * (second - first);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Haar wavelet of size `2 reach` steps whose first corner is (i, j); zero where it reaches beyond the image.
float2 wavelet(local const real *lattice, const Square *s, int corners, int i, int j, int reach)
{
    const int far = 2 * reach;
    const real x = s->left + i * s->step + s->column, y = s->top + j * s->step + s->row, edge = far * s->step;
    if (x < 0 || y < 0 || x + edge > s->width || y + edge > s->height)
        return (float2)(0.0f, 0.0f);
    local const real *above = lattice + j * corners + i, *centre = above + reach * corners;
    local const real *below = centre + reach * corners;
    return (float2)(
        (float)((below[0] - above[0]) - 2 * (below[reach] - above[reach]) + (below[far] - above[far])),
        (float)((below[far] - 2 * centre[far] + above[far]) - (below[0] - 2 * centre[0] + above[0])));
}

// Writes the unit descriptor: weighted sums of the samples' wavelets over 4 x 4 subregions. Of the 64 items each sums, in
// one subregion, one component (x, y) and its size where the other component has one sign.
void sum_regions(local const float2 *wavelets, int samples, constant float *weights, local float *terms,
                 global float *out)
{
    const int item = get_local_id(0), kind = item % 4;
    constant float *across = weights + item / 16 * samples, *along = weights + item / 4 % 4 * samples;
    float sum = 0.0f, size = 0.0f;
    for (int i = 0; i < samples; i++) {
        if (!(along[i] > 0.0f))
            continue;
        float column = 0.0f, column_size = 0.0f;
        for (int j = 0; j < samples; j++) {
            const float2 w = wavelets[j * samples + i];
            const float value = kind < 2 ? w.x : w.y, sign = kind < 2 ? w.y : w.x;
            if ((sign >= 0.0f) == (kind % 2 == 0)) {
                column += across[j] * value;
                column_size += across[j] * fabs(value);
            }
        }
        sum += along[i] * column;
        size += along[i] * column_size;
    }
    terms[2 * item] = sum, terms[2 * item + 1] = size;
    barrier(CLK_LOCAL_MEM_FENCE);
    float square = 0.0f;
    for (int k = 0; k < 2 * GROUP; k++)
        square += terms[k] * terms[k];
    const float scale = 1.0f / fmax(sqrt(square), 1e-12f);
    out += get_group_id(0) * 2 * GROUP;
    out[2 * item] = scale * sum, out[2 * item + 1] = scale * size;
}

// Descriptors (n, 128) along the axes of the image of `places` (n, 3): u, v, scale. Samples are `step` scale units apart.
kernel void describe_upright(global const uint *sums, const int width, const int height, global const float *places,
                             const int samples, const float step, constant float *weights, global float *out)
{
    local real lattice[(SAMPLES + 2) * (SAMPLES + 2)];
    local float terms[2 * GROUP];
    local float2 wavelets[SAMPLES * SAMPLES];
    const int corners = samples + 2;
    const Square s = square_around(sums, width, height, places + 3 * get_group_id(0), corners, step);
    read_lattice(sums, &s, corners, lattice);
    for (int k = get_local_id(0); k < samples * samples; k += GROUP)
        wavelets[k] = wavelet(lattice, &s, corners, k % samples, k / samples, 1);
    barrier(CLK_LOCAL_MEM_FENCE);
    sum_regions(wavelets, samples, weights, terms, out);
}

// Unit vector along the largest sum of wavelets of size 4 s, their own directions within 60 degrees.
float2 dominant_direction(local const real *lattice, const Square *s, local float2 *vectors, local int *sectors,
                          local float2 *bins)
{
    const int item = get_local_id(0), first = (TURNED_CORNERS - 4) / 2 - DISC_RADIUS;
    for (int k = item; k < DISC_SIDE * DISC_SIDE; k += GROUP) {
        const int i = k % DISC_SIDE - DISC_RADIUS, j = k / DISC_SIDE - DISC_RADIUS, squared = i * i + j * j;
        const float2 w = wavelet(lattice, s, TURNED_CORNERS, first + k % DISC_SIDE, first + k / DISC_SIDE, 2);
        vectors[k] = exp(-squared / 8.0f) * w;
        sectors[k] = squared > DISC_RADIUS * DISC_RADIUS
            ? -1 : (int)(DIRECTIONS / 2 * (atan2pi(w.y, w.x) + 1.0f)) % DIRECTIONS;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int sector = item; sector < DIRECTIONS; sector += GROUP) {
        float2 sum = 0.0f;
        for (int k = 0; k < DISC_SIDE * DISC_SIDE; k++)
            sum += sectors[k] == sector ? vectors[k] : (float2)(0.0f, 0.0f);
        bins[sector] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    float best = -1.0f;
    float2 direction = (float2)(1.0f, 0.0f);
    for (int start = 0; start < DIRECTIONS; start++) {
        float2 sum = 0.0f;
        for (int i = start; i < start + WINDOW; i++)
            sum += bins[i % DIRECTIONS];
        if (dot(sum, sum) > best) {
            best = dot(sum, sum);
            direction = sum;
        }
    }
    return best > 0.0f ? direction / sqrt(best) : (float2)(1.0f, 0.0f);
}

// The same, the square of samples turned to each keypoint's own direction; wavelets are bilinear between those at nodes.
kernel void describe_oriented(global const uint *sums, const int width, const int height, global const float *places,
                              constant float *weights, global float *out)
{
    local real lattice[TURNED_CORNERS * TURNED_CORNERS];
    local float terms[2 * GROUP];
    local float2 nodes[TURNED_NODES * TURNED_NODES], wavelets[SAMPLES * SAMPLES], bins[DIRECTIONS];
    local int sectors[DISC_SIDE * DISC_SIDE];
    const Square s = square_around(sums, width, height, places + 3 * get_group_id(0), TURNED_CORNERS, 1.0f);
    read_lattice(sums, &s, TURNED_CORNERS, lattice);
    // The disc's vectors lie where the samples will.
    const float2 ahead = dominant_direction(lattice, &s, wavelets, sectors, bins);
    for (int k = get_local_id(0); k < TURNED_NODES * TURNED_NODES; k += GROUP)
        nodes[k] = wavelet(lattice, &s, TURNED_CORNERS, k % TURNED_NODES, k / TURNED_NODES, 1);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int k = get_local_id(0); k < SAMPLES * SAMPLES; k += GROUP) {
        const float along = k % SAMPLES - 0.5f * (SAMPLES - 1), across = k / SAMPLES - 0.5f * (SAMPLES - 1);
        const float x = 0.5f * (TURNED_NODES - 1) - ahead.y * across + ahead.x * along;
        const float y = 0.5f * (TURNED_NODES - 1) + ahead.x * across + ahead.y * along;
        const int x0 = (int)x, y0 = (int)y;
        local const float2 *a = nodes + y0 * TURNED_NODES + x0, *b = a + TURNED_NODES;
        const float2 upper = a[0] + (x - x0) * (a[1] - a[0]), lower = b[0] + (x - x0) * (b[1] - b[0]);
        const float2 w = upper + (y - y0) * (lower - upper);
        wavelets[k] = (float2)(ahead.x * w.x + ahead.y * w.y, ahead.x * w.y - ahead.y * w.x);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    sum_regions(wavelets, SAMPLES, weights, terms, out);
}
