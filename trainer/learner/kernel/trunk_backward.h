// The gradients of features to those of the weights.
//
// A pooled output passes its gradient to one position of four, the winner, and to none where ReLU is
// off. What remains is a list of spikes: a gradient, and where the winner's window starts. The
// gradients of weights and inputs are sums over these lists.

#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "trunk_layers.h"

namespace {

// The gradient of a pooled output that has one, and where its winner's window starts.
struct Spike {
    float gradient;
    int start;
};

// Lists a filter's spikes; ``start`` counts numbers of an image whose channels are innermost.
template <class L>
int list_spikes(const float* gradients, int row_stride, int stride, const uint8_t* winners,
                Spike* spikes) {
    constexpr int RIGHT = L::CELL, DOWN = L::IMAGE_PITCH * RIGHT;
    constexpr int SHIFT[] = {0, RIGHT, DOWN, DOWN + RIGHT, 0};
    int count = 0;
    for (int row = 0; row < L::ROWS; ++row)
        for (int column = 0; column < L::COLUMNS; ++column) {
            const uint8_t winner = winners[row * L::PITCH + column];
            // Always written and kept only if it counts: no branch to mispredict.
            spikes[count] = {gradients[row * row_stride + column * stride],
                             2 * row * DOWN + 2 * column * RIGHT + SHIFT[winner]};
            count += winner != OFF;
        }
    return count;
}

// Rows of a window that fit into the registers together.
template <class L>
constexpr int rows_together() {
    constexpr int WIDTH = vectors(L::WINDOW);
    return 6 * WIDTH + 4 < REGISTERS ? 6 : 2 * WIDTH + 4 < REGISTERS ? 2 : 1;
}

// weights += sum of gradient * window.
template <class L>
void add_windows(const Spike* spikes, int count, const float* image, float* weights) {
    constexpr int TOGETHER = rows_together<L>(), WIDTH = vectors(L::WINDOW);
    for (int top = 0; top < SIDE; top += TOGETHER, weights += TOGETHER * L::PADDED_WINDOW) {
        Vector sums[TOGETHER][WIDTH] = {};
        for (int i = 0; i < count; ++i) {
            const float* window = image + spikes[i].start + top * L::IMAGE_PITCH * L::CELL;
            for (int row = 0; row < TOGETHER; ++row, window += L::IMAGE_PITCH * L::CELL)
                for (int j = 0; j < WIDTH; ++j)
                    sums[row][j] += spikes[i].gradient * load(window + j * LANES);
        }
        for (int row = 0; row < TOGETHER; ++row)
            for (int j = 0; j < WIDTH; ++j) {
                float* to = weights + row * L::PADDED_WINDOW + j * LANES;
                store(to, load(to) + sums[row][j]);
            }
    }
}

// window += gradient * weights, for each spike. The padding adds zeros to what follows the window.
template <class L>
void spread_spikes(const Spike* spikes, int count, const float* weights, float* image) {
    constexpr int TOGETHER = rows_together<L>(), WIDTH = vectors(L::WINDOW);
    for (int top = 0; top < SIDE; top += TOGETHER, weights += TOGETHER * L::PADDED_WINDOW) {
        Vector filter[TOGETHER][WIDTH];
        for (int row = 0; row < TOGETHER; ++row)
            for (int j = 0; j < WIDTH; ++j)
                filter[row][j] = load(weights + row * L::PADDED_WINDOW + j * LANES);
        for (int i = 0; i < count; ++i) {
            float* window = image + spikes[i].start + top * L::IMAGE_PITCH * L::CELL;
            for (int row = 0; row < TOGETHER; ++row, window += L::IMAGE_PITCH * L::CELL)
                for (int j = 0; j < WIDTH; ++j)
                    store(window + j * LANES,
                          load(window + j * LANES) + spikes[i].gradient * filter[row][j]);
        }
    }
}

// [CHANNELS][IMAGE_SIZE] to [IMAGE_SIZE][CELL]; what pads a cell is left alone.
template <class L, typename Number>
void interleave(const Number* planar, float* interleaved) {
    for (int i = 0; i < L::IMAGE_SIZE; ++i)
        for (int channel = 0; channel < L::CHANNELS; ++channel)
            interleaved[i * L::CELL + channel] = planar[channel * L::IMAGE_SIZE + i];
}

// Gradients of a layer's parameters.
template <class L>
struct Gradients {
    float weights[L::FILTERS][SIDE][L::PADDED_WINDOW], bias[L::FILTERS];

    void add(const Gradients& other) {
        const float* from = &other.weights[0][0][0];
        float* to = &weights[0][0][0];
        for (size_t i = 0; i < sizeof(weights) / sizeof(float); ++i) to[i] += from[i];
        for (int filter = 0; filter < L::FILTERS; ++filter) bias[filter] += other.bias[filter];
    }

    void write(float scale, float* to_weights, float* to_bias) const {
        for (int row = 0; row < L::FILTERS * SIDE; ++row)
            for (int i = 0; i < SIDE * L::CHANNELS; ++i)
                *to_weights++ =
                    weights[row / SIDE][row % SIDE][i / L::CHANNELS * L::CELL + i % L::CHANNELS] *
                    scale;
        std::copy_n(bias, L::FILTERS, to_bias);
    }
};

template <int FRAMES>
struct Sums {
    Gradients<FirstLayer<FRAMES>> first;
    Gradients<Second> second;
};

// What a thread needs for one image; channels are innermost.
template <int FRAMES>
struct BackwardScratch {
    using First = FirstLayer<FRAMES>;
    alignas(64) float image[First::IMAGE_SIZE * First::CELL];
    alignas(64) float hidden[First::SIZE * Second::CELL];
    alignas(64) float hidden_gradients[First::SIZE * Second::CELL];
    Spike spikes[First::SIZE];  // of one filter at a time
};

template <int FRAMES>
void backward_image(const float* weights2, const uint8_t* winners1, const uint8_t* winners2,
                    const float* gradients, BackwardScratch<FRAMES>& scratch, Sums<FRAMES>& sums) {
    using First = FirstLayer<FRAMES>;
    Spike* spikes = scratch.spikes;
    const auto sum = [spikes](int count) {
        float total = 0;
        for (int i = 0; i < count; ++i) total += spikes[i].gradient;
        return total;
    };
    std::fill_n(scratch.hidden_gradients, First::SIZE * Second::CELL, 0.0f);
    for (int filter = 0; filter < Second::FILTERS; ++filter) {
        const int count = list_spikes<Second>(gradients + filter * POOLED, Second::COLUMNS, 1,
                                              winners2 + filter * Second::SIZE, spikes);
        add_windows<Second>(spikes, count, scratch.hidden, sums.second.weights[filter][0]);
        spread_spikes<Second>(spikes, count, weights2 + filter * SIDE * Second::PADDED_WINDOW,
                              scratch.hidden_gradients);
        sums.second.bias[filter] += sum(count);
    }
    for (int filter = 0; filter < First::FILTERS; ++filter) {
        const int count = list_spikes<First>(
            scratch.hidden_gradients + filter, First::PITCH * Second::CELL, Second::CELL,
            winners1 + filter * First::SIZE, spikes);
        add_windows<First>(spikes, count, scratch.image, sums.first.weights[filter][0]);
        sums.first.bias[filter] += sum(count);
    }
}

constexpr int64_t CHUNK = 8;  // images that share their sums

template <int FRAMES>
void backward(const uint8_t* frames, int64_t image_stride, int64_t images, const float* weights2,
              const float* hidden, const uint8_t* winners1, const uint8_t* winners2,
              const float* gradients, float* to_weights1, float* to_bias1, float* to_weights2,
              float* to_bias2, int threads) {
    using First = FirstLayer<FRAMES>;
    std::vector<float> padded2(Second::FILTERS * SIDE * Second::PADDED_WINDOW);
    for (int pixel = 0; pixel < Second::FILTERS * SIDE * SIDE; ++pixel)
        std::copy_n(weights2 + pixel * Second::CHANNELS, Second::CHANNELS,
                    &padded2[pixel / SIDE * Second::PADDED_WINDOW + pixel % SIDE * Second::CELL]);
    std::vector<Sums<FRAMES>> sums((images + CHUNK - 1) / CHUNK);
#pragma omp parallel num_threads(threads) if (images > CHUNK)
    {
        const auto scratch = std::make_unique<BackwardScratch<FRAMES>>();
#pragma omp for schedule(dynamic)
        for (int64_t first = 0; first < images; first += CHUNK)
            for (int64_t image = first; image < std::min(images, first + CHUNK); ++image) {
                interleave<First>(frames + image * image_stride, scratch->image);
                interleave<Second>(hidden + image * First::OUTPUTS, scratch->hidden);
                backward_image<FRAMES>(padded2.data(), winners1 + image * First::OUTPUTS,
                                       winners2 + image * Second::OUTPUTS,
                                       gradients + image * FEATURES, *scratch, sums[first / CHUNK]);
            }
    }
    Sums<FRAMES> total = {};
    for (const Sums<FRAMES>& part : sums) {
        total.first.add(part.first);
        total.second.add(part.second);
    }
    total.first.write(1.0f / 255.0f, to_weights1, to_bias1);
    total.second.write(1.0f, to_weights2, to_bias2);
}

}  // namespace
