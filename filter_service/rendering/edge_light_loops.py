"""Compiled loops of `edge_light.py` and `edge_kinds.py`.

Those that take ``start`` and ``end`` process a part of their range, for threads; see
`haze.run_in_threads`.
"""

import numpy as np
from numba import njit

from filter_service.constants import FIELD_CORNERS, RGB
from filter_service.psfs.read_loops import channel_taps, clipped


@njit(cache=True, nogil=True, error_model="numpy")
def blend_edges(tables, reads, edges, maps, kinds, zero_dpt, outputs):
    """Blend the edges of each kind of source over field, pupil and accommodation.

    Parameters
    ----------
    tables : StoreTables
    reads : StateReads
    edges : EdgeTables
    maps : (node_from_cell, cell_from_node), each (n_cells, 3, 2, 2)
    kinds : cell (n,), nodes (n, 3), weight_ratio (n, 3), layer_dpt (n,)
    zero_dpt : (n_fields, 3)
    outputs : slope_px (n, 3, n_edge, 2), half_um_per_px (n, 3, 2, 2), edge_um (n, 3),
        shift_px_per_um (n, 2, 2), center_px_per_dpt (n, 2)
    """
    node_from_cell, cell_from_node = maps
    cells, nodes, weights, layer_dpt = kinds
    slope_px, half, edge_um, shift, center = outputs
    for k in range(cells.size):
        cell = cells[k]
        for j in range(FIELD_CORNERS):
            node = nodes[k, j]
            into, back = node_from_cell[cell, j], cell_from_node[cell, j]
            for corner in range(reads.groups.size):
                group = reads.groups[corner] + node
                scale = reads.scales[corner]
                weight = weights[k, j] * reads.weights[corner]
                if weight == 0.0:
                    continue
                first, last = tables.starts[group], tables.starts[group + 1] - 1
                for channel in range(RGB):
                    kept = tables.channel_shift_dpt[group, channel]
                    t = (layer_dpt[k] + zero_dpt[node, channel]) * scale - kept
                    low, high = tables.values_dpt[first], tables.values_dpt[last]
                    total = clipped(t, low, high) + kept
                    zero_px = edges.slope_px[group, channel]
                    per_dpt_px = edges.slope_px_per_dpt[group, channel]
                    for i in range(zero_px.shape[0]):
                        x = zero_px[i, 0] + total * per_dpt_px[i, 0]
                        y = zero_px[i, 1] + total * per_dpt_px[i, 1]
                        for row in range(2):
                            slope_px[k, channel, i, row] += weight * (
                                back[row, 0] * x + back[row, 1] * y
                            )
                    for row in range(2):
                        for column in range(2):
                            of_node = edges.half_um_per_px[group, channel]
                            half[k, channel, row, column] += (
                                weight
                                * scale
                                * (
                                    into[0, row] * of_node[0, column]
                                    + into[1, row] * of_node[1, column]
                                )
                            )
                    edge_um[k, channel] += weight * edges.edge_light_um[group, channel]
                for row in range(2):
                    for column in range(2):
                        total = 0.0
                        for a in range(2):
                            for b in range(2):
                                total += (
                                    back[row, a]
                                    * edges.shift_px_per_um[group, a, b]
                                    * back[column, b]
                                )
                        shift[k, row, column] += weight * total
                    center[k, row] += (
                        weight
                        * scale
                        * (
                            back[row, 0] * edges.center_px_per_dpt[group, 0]
                            + back[row, 1] * edges.center_px_per_dpt[group, 1]
                        )
                    )


@njit(cache=True, nogil=True, error_model="numpy")
def omitted_ratio(tables, reads, kind, zero_dpt, maps, reach, omitted):
    """Write the share of the blended kernels that ends before each pixel.

    Parameters
    ----------
    kind : nodes (3,), weight_ratio (3,), layer_dpt (2,), layer_ratio (2,)
        Field nodes and layers that the kernel is blended of.
    maps : (3, 2, 2)
        Maps from the image's pixels to the stored ones, as in `FrameKernels`.
    omitted : (3, side, side)
        Output; pixels are at integer offsets.
    """
    nodes, weights, layer_dpt, layer_ratio = kind
    half = omitted.shape[1] // 2
    n_taps = 2 * reads.groups.size
    psfs, tap_weights = np.empty(n_taps, np.int64), np.empty(n_taps)
    uppers = np.empty(reads.groups.size, np.int64)
    omitted[:] = 1.0
    for channel in range(RGB):
        for j in range(FIELD_CORNERS):
            if weights[j] == 0.0:
                continue
            m = maps[j]
            for layer in range(2):
                if layer_ratio[layer] == 0.0:
                    continue
                for corner in range(reads.groups.size):
                    uppers[corner] = tables.starts[reads.groups[corner] + nodes[j]]
                total = layer_dpt[layer] + zero_dpt[nodes[j], channel]
                outputs = uppers, psfs, tap_weights
                channel_taps(tables, reads, nodes[j], channel, total, *outputs)
                for tap in range(n_taps):
                    share = tap_weights[tap] * weights[j] * layer_ratio[layer]
                    if share == 0.0:
                        continue
                    word = np.int64(tables.reach_words[psfs[tap]])
                    left, right = word & 255, (word >> 8) & 255
                    up, down = (word >> 16) & 255, word >> 24
                    for y in range(-min(reach, half), min(reach, half) + 1):
                        for x in range(-min(reach, half), min(reach, half) + 1):
                            u = m[0, 0] * x + m[0, 1] * y
                            v = m[1, 0] * x + m[1, 1] * y
                            if (
                                -left - 0.5 < u < right + 0.5
                                and -up - 0.5 < v < down + 0.5
                            ):
                                omitted[channel, half + y, half + x] -= share


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _edge_light(x, y, edge, seen, scratch):
    """Return the density of the light that an edge sends to a point, in pixels.

    An edge element ds with slope s and normal n lights the points p = s + d n, for d of
    either sign.  With f = (p - s) . t for the tangent t, these are the elements where f
    changes its sign along the edge, and the density there is 1 / d² |ds / df|, see
    `survey.needed_radius_px`.  Its mean over a pixel is taken along t and n, so that it
    is finite on caustics, where f has a double zero.

    Parameters
    ----------
    edge : (8, n_edge + 1), float32
        x and y of slopes, tangents and normals, lengths, and sines of the angle to the
        next tangent.  The first element is repeated at the end.
    seen : (n_edge,), float32
        Visible share of the edge from each element to the next.
    scratch : (2, n_edge + 1), float32
    """
    half, quarter, sixth = np.float32(0.5), np.float32(0.25), np.float32(1.0 / 6.0)
    none, one, least = np.float32(0.0), np.float32(1.0), np.float32(1e-3)
    across, along = scratch[0], scratch[1]
    for k in range(edge.shape[1]):
        from_x, from_y = x - edge[0, k], y - edge[1, k]
        across[k] = from_x * edge[2, k] + from_y * edge[3, k]
        along[k] = from_x * edge[4, k] + from_y * edge[5, k]
    # Slices, because LLVM does not vectorize a loop over k and k + 1.
    across_here, across_next = scratch[0, :-1], scratch[0, 1:]
    along_here, along_next = scratch[1, :-1], scratch[1, 1:]
    total = none
    for k in range(seen.shape[0]):
        rise = across_next[k] - across_here[k]
        middle = half * (across_next[k] + across_here[k])
        # At least `least`, so that an interval of zero length counts once.
        change = max(abs(rise), least)
        low, high = middle - half * change, middle + half * change
        overlap = max(min(high, half) - max(low, -half), none)
        # At the zero of f: the normal turns between the elements.
        distance = half * (along_here[k] + along_next[k])
        distance -= sixth * edge[7, k] * rise
        square = max(distance * distance, one) - quarter
        total += seen[k] * edge[6, k] * overlap / (change * square)
    return total


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def fill_polar(start, end, edges, kernel_kind, seen, rho_px, directions, polar):
    """Write tables (n, n_phi, n_fine, 3) of light times rho³.

    It is computed at distances (n_rho,), and interpolated so that the reciprocals of
    the distances are evenly spaced between them.  For a round spot of radius g,
    (light rho³)^-1/2 is proportional to 1 - g / rho, and so linear in 1 / rho.
    """
    scratch = np.empty((2, edges.shape[3]), np.float32)
    n_phi, one = directions.shape[0], np.float32(1.0)
    fine = (polar.shape[2] - 1) // (rho_px.size - 1)
    before = np.empty(RGB, np.float32)
    for line in range(start, end):
        n, m = line // n_phi, line % n_phi
        for r in range(rho_px.size):
            x, y = rho_px[r] * directions[m, 0], rho_px[r] * directions[m, 1]
            cube = rho_px[r] * rho_px[r] * rho_px[r]
            for c in range(RGB):
                light = _edge_light(x, y, edges[kernel_kind[n], c], seen[n], scratch)
                polar[n, m, fine * r, c] = light * cube
                root = one / np.sqrt(max(light * cube, np.float32(1e-12)))
                for k in range(1, fine if r else 0):
                    part = np.float32(k) / np.float32(fine)
                    between = before[c] + part * (root - before[c])
                    polar[n, m, fine * (r - 1) + k, c] = one / (between * between)
                before[c] = root


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def fill_kernels(start, end, places, polar, near, kernels):
    """Write rows of kernels (n, side, side, 3) of light.

    Parameters
    ----------
    places : share, rho_index, phi_index, each (side, side), float32
        Factor of each offset, and its position among the points of the tables.
    polar : (n, n_phi, n_fine, 3), float32
        See `fill_polar`.
    near : edges, kernel_kind (n,), seen (n, n_edge), radius_px (n,), omitted, index
        Up to the radius, light is computed from the edges; ``omitted`` (n_own, 3, side,
        side) is the share that ordinary kernels omit, by its index.  It has no pixels
        for kernels on coarse grids.
    """
    share, rho_index, phi_index = places
    edges, kernel_kind, seen, radius_px, omitted, index = near
    n_phi, side = polar.shape[1], kernels.shape[1]
    half, is_near = side // 2, omitted.shape[2] > 0
    scratch = np.empty((2, edges.shape[3]), np.float32)
    none = np.float32(0.0)
    for line in range(start, end):
        n, row = line // side, line % side
        table, reach = polar[n], radius_px[n] * radius_px[n]
        y = np.float32(row - half)
        for column in range(side):
            x = np.float32(column - half)
            here = share[row, column]
            kernels[n, row, column] = none
            if here == none:
                continue
            if is_near and x * x + y * y < reach:
                for c in range(RGB):
                    ratio = omitted[index[n], c, row, column]
                    if ratio > np.float32(1e-6):
                        edge = edges[kernel_kind[n], c]
                        light = _edge_light(x, y, edge, seen[n], scratch)
                        kernels[n, row, column, c] = ratio * light
                continue
            r, m = int(rho_index[row, column]), int(phi_index[row, column])
            right = rho_index[row, column] - np.float32(r)
            down = phi_index[row, column] - np.float32(m)
            m %= n_phi
            after = (m + 1) % n_phi
            for c in range(RGB):
                first, last = table[m, r, c], table[after, r, c]
                first += right * (table[m, r + 1, c] - first)
                last += right * (table[after, r + 1, c] - last)
                kernels[n, row, column, c] = here * (first + down * (last - first))
