// SPDX-License-Identifier: Apache-2.0
// SURF keypoints on a GPU: the steps of surf_detector.py, surf_hessian.py and surf_integral.py, one work item per pixel.
//
// Sums are whole numbers, determinants and vertices are put together as on the CPU: both agree to the last bit where the
// device rounds as IEEE 754 says and has double precision (DOUBLE). The macros are defined by opencl_surf.py, most from
// the CPU's own constants; GROUP is the number of work items that sum a row together.
#pragma OPENCL FP_CONTRACT OFF
#if DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double real;
#else
typedef float real;
#endif

// The image enlarged twice, (2 width, 2 height): bilinear as surf_integral.py does it.
kernel void enlarge(global const uchar *image, const int width, const int height, global uchar *out)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= 2 * width || y >= 2 * height)
        return;
    const int x0 = x / 2, x1 = clamp(x0 + 2 * (x % 2) - 1, 0, width - 1);
    const int y0 = y / 2, y1 = clamp(y0 + 2 * (y % 2) - 1, 0, height - 1);
    const uint own = 3 * image[y0 * width + x0] + image[y0 * width + x1];
    const uint other = 3 * image[y1 * width + x0] + image[y1 * width + x1];
    out[y * 2 * width + x] = ((3 * own >> 2) + (other >> 2) + 2) >> 2;
}

// Means of four pixels each, (width / 2, height / 2).
kernel void halve(global const uchar *image, const int width, const int height, global uchar *out)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width / 2 || y >= height / 2)
        return;
    global const uchar *above = image + 2 * y * width + 2 * x, *below = above + width;
    out[y * (width / 2) + x] = (above[0] + above[1] + below[0] + below[1] + 2) >> 2;
}

// Sums along each row, written to (height + 1, width + 1); one group per row, each item a piece of it.
kernel void sum_rows(global const uchar *image, const int width, global uint *sums)
{
    local uint totals[GROUP];
    const int y = get_group_id(0), item = get_local_id(0), piece = (width + GROUP - 1) / GROUP;
    const int begin = min(item * piece, width), end = min(begin + piece, width);
    global const uchar *row = image + y * width;
    global uint *out = sums + (y + 1) * (width + 1);
    uint total = 0;
    for (int x = begin; x < end; x++)
        total += row[x];
    totals[item] = total;
    barrier(CLK_LOCAL_MEM_FENCE);
    total = 0;
    for (int k = 0; k < item; k++)
        total += totals[k];
    if (item == 0)
        out[0] = 0;
    for (int x = begin; x < end; x++) {
        total += row[x];
        out[x + 1] = total;
    }
}

// Those sums added up along each column of (height + 1, columns): the integral image. Groups of (columns, pieces) items.
kernel void sum_columns(global uint *sums, const int columns, const int height)
{
    local uint totals[GROUP];
    const int x = get_global_id(0), item = get_local_id(1), side = get_local_size(0), at = get_local_id(0);
    const int pieces = get_local_size(1), piece = (height + pieces - 1) / pieces;
    const int begin = min(item * piece, height), end = x < columns ? min(begin + piece, height) : begin;
    uint total = 0;
    for (int y = begin; y < end; y++)
        total += sums[(y + 1) * columns + x];
    totals[item * side + at] = total;
    barrier(CLK_LOCAL_MEM_FENCE);
    total = 0;
    for (int k = 0; k < item; k++)
        total += totals[k * side + at];
    if (item == 0 && x < columns)
        sums[x] = 0;
    for (int y = begin; y < end; y++) {
        total += sums[(y + 1) * columns + x];
        sums[(y + 1) * columns + x] = total;
    }
}

int box(global const uint *sums, int columns, int left, int top, int right, int bottom)
{
    global const uint *upper = sums + top * columns, *lower = sums + bottom * columns;
    return (int)(lower[right] - lower[left] - upper[right] + upper[left]);
}

// Determinant of the Hessian by box filters of an edge of `size` px, normalised by their area.
float determinant(global const uint *sums, int columns, int x, int y, int size)
{
    const int lobe = size / 3, half_size = size / 2, middle = lobe / 2;
    const int left = x - lobe + 1, right = x + lobe, top = y - lobe + 1, bottom = y + lobe;
    const int xx = box(sums, columns, x - half_size, top, x + half_size + 1, bottom)
        - 3 * box(sums, columns, x - middle, top, x + middle + 1, bottom);
    const int yy = box(sums, columns, left, y - half_size, right, y + half_size + 1)
        - 3 * box(sums, columns, left, y - middle, right, y + middle + 1);
    const int xy = box(sums, columns, x - lobe, y - lobe, x, y) - box(sums, columns, x + 1, y - lobe, x + lobe + 1, y)
        + box(sums, columns, x + 1, y + 1, x + lobe + 1, y + lobe + 1)
        - box(sums, columns, x - lobe, y + 1, x, y + lobe + 1);
    const float scale = (float)((real)1 / (size * size)); // division of floats may be inexact on a GPU
    const float dxx = (float)xx * scale, dyy = (float)yy * scale, dxy = (float)xy * scale;
    return dxx * dyy - 0.81f * dxy * dxy;
}

// Both middle layers, (2, height, width); zero where a filter does not fit.
kernel void fill_layers(global const uint *sums, const int width, const int height, global float *layers)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height)
        return;
    for (int layer = 0; layer < 2; layer++) {
        const int size = layer ? LARGER : SMALLER, reach = size / 2;
        const bool fits = x >= reach && y >= reach && x < width - reach && y < height - reach;
        layers[(layer * height + y) * width + x] = fits ? determinant(sums, width + 1, x, y, size) : 0.0f;
    }
}

// Copies the 3 x 3 pixels around (x, y) of a layer; false if one that is not `own` reaches `value`.
bool copy_below(global const float *layer, int width, int x, int y, float value, bool own, float *out)
{
    bool below = true;
    for (int j = 0; j < 3; j++)
        for (int i = 0; i < 3; i++) {
            out[3 * j + i] = layer[(y + j - 1) * width + x + i - 1];
            below = below && (out[3 * j + i] < value || (own && i == 1 && j == 1));
        }
    return below;
}

// The same for a layer that is not filtered everywhere.
bool fill_outer(global const uint *sums, int width, int x, int y, int size, float value, float *out)
{
    for (int k = 0; k < 9; k++) {
        const int at = (k + 4) % 9;
        out[at] = determinant(sums, width + 1, x + at % 3 - 1, y + at / 3 - 1, size);
        if (!(out[at] < value))
            return false;
    }
    return true;
}

// Vertex of the parabola through a neighbourhood (scale, v, u) relative to its centre; false if it lies outside.
bool vertex(const float *c, real *offset)
{
    const real twice = 2 * (real)c[13];
    const real gx = (real)0.5f * (c[14] - c[12]), gy = (real)0.5f * (c[16] - c[10]), gs = (real)0.5f * (c[22] - c[4]);
    const real xx = c[14] + c[12] - twice, yy = c[16] + c[10] - twice, ss = c[22] + c[4] - twice;
    const real xy = (real)0.25f * (c[17] - c[15] - c[11] + c[9]);
    const real xs = (real)0.25f * (c[23] - c[21] - c[5] + c[3]);
    const real ys = (real)0.25f * (c[25] - c[19] - c[7] + c[1]);
    const real m00 = yy * ss - ys * ys, m01 = xs * ys - xy * ss, m02 = xy * ys - xs * yy;
    const real m11 = xx * ss - xs * xs, m12 = xy * xs - xx * ys, m22 = xx * yy - xy * xy;
    const real det = xx * m00 + xy * m01 + xs * m02, most = (real)6 / 10;
    if (fabs(det) < (real)1e-30f)
        return false;
    offset[0] = -(m00 * gx + m01 * gy + m02 * gs) / det;
    offset[1] = -(m01 * gx + m11 * gy + m12 * gs) / det;
    offset[2] = -(m02 * gx + m12 * gy + m22 * gs) / det;
    return fabs(offset[0]) <= most && fabs(offset[1]) <= most && fabs(offset[2]) <= most;
}

// Appends maxima of 3 x 3 x 3 neighbourhoods above `threshold` to `found`: u, v, scale, response. `pixel` is the edge of
// this image's pixels in those of the first octave. They come in any order: `keys` tell in which the CPU finds them.
kernel void find_maxima(
    global const uint *sums, global const float *layers, const int width, const int height, const float threshold,
    const float pixel, const uint first_key, const uint room, global uint *count, global float4 *found,
    global uint *keys)
{
    const int x = get_global_id(0), y = get_global_id(1);
    for (int place = 0; place < 2; place++) {
        const int border = place ? BORDER_LARGER : BORDER_SMALLER;
        if (x < border || y < border || x >= width - border || y >= height - border)
            continue;
        global const float *own = layers + place * width * height, *other = layers + (1 - place) * width * height;
        const float value = own[y * width + x];
        if (!(value > threshold))
            continue;
        float cube[27];
        real offset[3];
        if (!copy_below(own, width, x, y, value, true, cube + 9)
            || !copy_below(other, width, x, y, value, false, cube + 18 - 18 * place)
            || !fill_outer(sums, width, x, y, place ? LARGEST : SMALLEST, value, cube + 18 * place)
            || !vertex(cube, offset))
            continue;
        const uint at = atomic_inc(count);
        if (at >= room)
            continue;
        const real size = (place ? LARGER : SMALLER) + offset[2] * STEP;
        const float u = x + offset[0], v = y + offset[1], scale = (real)12 / 10 / 9 * size;
        found[at] = (float4)((u + 0.5f) * pixel - 0.5f, (v + 0.5f) * pixel - 0.5f, scale * pixel, value);
        keys[at] = first_key + (2 * y + place) * width + x;
    }
}
