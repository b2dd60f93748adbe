// Frames to features.
//
// Pooling needs the four outputs of a 2x2 block together, and neighbours share inputs. In one
// dimension: split the filter h into its even taps h0 and odd taps h1, and let x0, x1 and x2 be the
// inputs from 2p, 2p + 1 and 2p + 2 on, every second one. Three convolutions replace four:
//
//   y(2p)     = h0*x0 + h1*x1 = m0 + m1      m0 = h0*(x0 - x1)
//   y(2p + 1) = h0*x1 + h1*x2 = m1 + m2      m1 = (h0 + h1)*x1      m2 = h1*(x2 - x1)
//
// In two dimensions that is 9 convolutions of 3x3 taps in place of 16, so 44% of the
// multiplications are saved, and equal inputs still give exactly equal outputs. The 9 pictures to
// convolve are called planes below, the 9 results products.
//
// In reduced precision two channels' planes, and their weights, are rounded to bfloat16 and lie side
// by side in 32 bits, a pair: one instruction multiplies and adds both, in single precision. Where
// the processor has no such instruction, reduced precision is single precision.

#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "trunk_layers.h"

namespace {

// The 9 planes of the channels that share a cell: x0 - x1, x1 and x2 - x1 in both directions.
template <class L, typename Cell, typename Pixel>
void make_planes(const Pixel* image, int channel_stride, Cell* planes) {
    constexpr int PACKED = L::template PACKED<Cell>, STRIDE = L::template STACKS<Cell> * L::PLANE;
    constexpr int WIDTH = 2 * L::PITCH + 1;
    for (int row = 0; row < L::ROWS + 2; ++row) {
        float down[3][PACKED][WIDTH];
        for (int channel = 0; channel < PACKED; ++channel) {
            const Pixel* x = image + channel * channel_stride + 2 * row * L::IMAGE_PITCH;
            for (int i = 0; i < WIDTH; ++i) {
                const float x1 = x[i + L::IMAGE_PITCH];
                down[0][channel][i] = x[i] - x1;
                down[1][channel][i] = x1;
                down[2][channel][i] = x[i + 2 * L::IMAGE_PITCH] - x1;
            }
        }
        for (int part = 0; part < 3; ++part) {
            Cell* out = planes + 3 * part * STRIDE + row * L::PITCH;
            for (int i = 0; i < L::PITCH; ++i) {
                float left[PACKED], middle[PACKED], right[PACKED];
                for (int channel = 0; channel < PACKED; ++channel) {
                    const float* x = down[part][channel] + 2 * i;
                    left[channel] = x[0] - x[1];
                    middle[channel] = x[1];
                    right[channel] = x[2] - x[1];
                }
                pack(left, out + i), pack(middle, out + STRIDE + i);
                pack(right, out + 2 * STRIDE + i);
            }
        }
    }
}

template <class L, typename Cell, typename Pixel>
void make_all_planes(const Pixel* image, int channel_stride, Cell* planes) {
    for (int stack = 0; stack < L::template STACKS<Cell>; ++stack, planes += L::PLANE)
        make_planes<L>(image + stack * L::template PACKED<Cell> * channel_stride, channel_stride,
                       planes);
}

// The 9 weights of a filter's tap: h0, h0 + h1 and h1 in both directions.
template <class L>
void split_tap(const float* corner, float scale, float products[PRODUCTS]) {
    float parts[3][3];
    for (int down = 0; down < 3; down += 2) {
        const float* at = corner + down / 2 * SIDE * L::CHANNELS;
        parts[down][0] = at[0] * scale, parts[down][2] = at[L::CHANNELS] * scale;
        parts[down][1] = parts[down][0] + parts[down][2];
    }
    for (int right = 0; right < 3; ++right) parts[1][right] = parts[0][right] + parts[2][right];
    std::copy_n(&parts[0][0], PRODUCTS, products);
}

// Weights [filter][6][6][channel] to [product][stack of channels][tap][filter].
template <class L, typename Cell>
std::vector<Cell> split_weights(const float* weights, float scale) {
    constexpr int PACKED = L::template PACKED<Cell>, STACKS = L::template STACKS<Cell>;
    std::vector<Cell> split(PRODUCTS * STACKS * TAPS * L::FILTERS);
    for (int filter = 0; filter < L::FILTERS; ++filter)
        for (int stack = 0; stack < STACKS; ++stack)
            for (int tap = 0; tap < TAPS; ++tap) {
                const int row = filter * SIDE * SIDE + tap / 3 * 2 * SIDE + tap % 3 * 2;
                float products[PACKED][PRODUCTS];
                for (int i = 0; i < PACKED; ++i)
                    split_tap<L>(weights + row * L::CHANNELS + stack * PACKED + i, scale,
                                 products[i]);
                for (int product = 0; product < PRODUCTS; ++product) {
                    float channels[PACKED];
                    for (int i = 0; i < PACKED; ++i) channels[i] = products[i][product];
                    pack(channels, &split[((product * STACKS + stack) * TAPS + tap) * L::FILTERS +
                                          filter]);
                }
            }
    return split;
}

// Adds up blocks of 2x2 outputs from their products, which lie ``stride`` apart, and pools them. As
// in torch, the first of equals wins.
inline void pool(const float* products, int stride, float bias, float* output, uint8_t* winner) {
    Vector down[2][3];
    for (int right = 0; right < 3; ++right) {
        const Vector middle = load(products + (3 + right) * stride);
        down[0][right] = load(products + right * stride) + middle;
        down[1][right] = middle + load(products + (6 + right) * stride);
    }
    Vector best = down[0][0] + down[0][1];
    Integers place = {};
    for (int next = 1; next < 4; ++next) {
        const Vector value = down[next / 2][next % 2] + down[next / 2][next % 2 + 1];
        const Integers wins = value > best;
        best = wins ? value : best;
        place = wins ? Integers{} + next : place;
    }
    best += bias;
    const Integers on = best > Vector{};
    store(output, best < Vector{} ? Vector{} : best);  // not the mask: NaN should stay NaN
    *reinterpret_cast<LooseBytes*>(winner) =
        __builtin_convertvector(on ? place : Integers{} + OFF, Bytes);
}

// One product at WIDE vectors of positions for GROUP filters, with all sums in registers.
template <class L, typename Cell>
void multiply(const Cell* planes, const Cell* weights, float products[L::GROUP][WIDE * LANES]) {
    Vector sums[L::GROUP][WIDE] = {};
    for (int stack = 0; stack < L::template STACKS<Cell>; ++stack, planes += L::PLANE)
        for (int tap = 0; tap < TAPS; ++tap, weights += L::FILTERS)
            for (int filter = 0; filter < L::GROUP; ++filter)
                for (int i = 0; i < WIDE; ++i)
                    sums[filter][i] =
                        add_product(sums[filter][i], weights[filter],
                                    planes + tap / 3 * L::PITCH + tap % 3 + i * LANES);
    for (int filter = 0; filter < L::GROUP; ++filter)
        for (int i = 0; i < WIDE; ++i) store(&products[filter][i * LANES], sums[filter][i]);
}

// Planes [product][stack][PLANE] to outputs and winners [filter][SIZE].
template <class L, typename Cell>
void convolve(const Cell* planes, const Cell* weights, const float* bias, float* outputs,
              uint8_t* winners) {
    constexpr int TILE = WIDE * LANES, STACKS = L::template STACKS<Cell>;
    float products[PRODUCTS][L::GROUP][TILE];
    for (int tile = 0; tile < L::SIZE; tile += TILE)
        for (int group = 0; group < L::FILTERS; group += L::GROUP) {
            for (int product = 0; product < PRODUCTS; ++product)
                multiply<L>(planes + product * STACKS * L::PLANE + tile,
                            weights + product * STACKS * TAPS * L::FILTERS + group,
                            products[product]);
            for (int filter = 0; filter < L::GROUP; ++filter)
                for (int i = 0; i < TILE; i += LANES) {
                    const int at = (group + filter) * L::SIZE + tile + i;
                    pool(&products[0][filter][i], L::GROUP * TILE, bias[group + filter],
                         outputs + at, winners + at);
                }
        }
}

// What a thread needs for one image. It starts as zeros: unused positions may hold anything, but
// reading them should not meet slow denormal numbers.
template <int FRAMES, typename Cell>
struct ForwardScratch {
    using First = FirstLayer<FRAMES>;
    typename First::template Fitting<Cell> planes1[First::PLANES];
    Cell planes2[Second::PLANES];
    float hidden[First::OUTPUTS], outputs[Second::OUTPUTS];
    uint8_t winners1[First::OUTPUTS], winners2[Second::OUTPUTS];
};

template <int FRAMES, typename Cell>
void forward(const uint8_t* frames, int64_t image_stride, int64_t images, const float* weights1,
             const float* bias1, const float* weights2, const float* bias2, float* features,
             float* hidden, uint8_t* winners1, uint8_t* winners2, int threads) {
    using First = FirstLayer<FRAMES>;
    using Cell1 = typename First::template Fitting<Cell>;
    const auto split1 = split_weights<First, Cell1>(weights1, 1.0f / 255.0f);
    const auto split2 = split_weights<Second, Cell>(weights2, 1.0f);
#pragma omp parallel num_threads(threads) if (images > 1)
    {
        const auto scratch = std::make_unique<ForwardScratch<FRAMES, Cell>>();
#pragma omp for schedule(dynamic)
        for (int64_t image = 0; image < images; ++image) {
            float* between = hidden ? hidden + image * First::OUTPUTS : scratch->hidden;
            uint8_t* won1 = hidden ? winners1 + image * First::OUTPUTS : scratch->winners1;
            uint8_t* won2 = hidden ? winners2 + image * Second::OUTPUTS : scratch->winners2;
            make_all_planes<First>(frames + image * image_stride, First::IMAGE_SIZE,
                                   scratch->planes1);
            convolve<First>(scratch->planes1, split1.data(), bias1, between, won1);
            make_all_planes<Second>(between, First::SIZE, scratch->planes2);
            convolve<Second>(scratch->planes2, split2.data(), bias2, scratch->outputs, won2);
            for (int row = 0; row < Second::FILTERS * Second::ROWS; ++row)
                std::copy_n(scratch->outputs + row / Second::ROWS * Second::SIZE +
                                row % Second::ROWS * Second::PITCH,
                            Second::COLUMNS, features + image * FEATURES + row * Second::COLUMNS);
        }
    }
}

}  // namespace
