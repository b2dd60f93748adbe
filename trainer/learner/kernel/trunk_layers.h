// Vectors, and the sizes of the networks' two layers.

#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#if defined(__AVX512BF16__)
#include <immintrin.h>
#endif

namespace {

#if defined(__AVX512F__)
constexpr int LANES = 16, REGISTERS = 32;
#elif defined(__AVX__)
constexpr int LANES = 8, REGISTERS = 16;
#elif defined(__aarch64__)
constexpr int LANES = 4, REGISTERS = 32;
#else
constexpr int LANES = 4, REGISTERS = 16;
#endif
typedef float Vector __attribute__((vector_size(4 * LANES)));
typedef int32_t Integers __attribute__((vector_size(4 * LANES)));
typedef uint8_t Bytes __attribute__((vector_size(LANES)));
// The same at an address that need not be aligned.
typedef float LooseVector __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef uint8_t LooseBytes __attribute__((vector_size(LANES), aligned(1), may_alias));

inline Vector load(const float* from) { return *reinterpret_cast<const LooseVector*>(from); }
inline void store(float* to, Vector value) { *reinterpret_cast<LooseVector*>(to) = value; }

#if defined(__AVX512BF16__)
typedef uint32_t Pair;  // of bfloat16: the even channel in the lower half
inline uint32_t bfloat16(float value) {
    uint32_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    return (bits + 0x7fff + (bits >> 16 & 1)) >> 16;  // to nearest, ties to even
}
inline void pack(const float (&channels)[2], Pair* to) {
    *to = bfloat16(channels[0]) | bfloat16(channels[1]) << 16;
}
inline Vector add_product(Vector sum, Pair weight, const Pair* plane) {
    return _mm512_dpbf16_ps(sum, (__m512bh)_mm512_loadu_si512(plane),
                            (__m512bh)_mm512_set1_epi32(weight));
}
#else
typedef float Pair;
#endif
inline void pack(const float (&channel)[1], float* to) { *to = channel[0]; }
inline Vector add_product(Vector sum, float weight, const float* plane) {
    return sum + weight * load(plane);
}

constexpr int vectors(int floats) { return (floats + LANES - 1) / LANES; }

constexpr int SIDE = 6;                // of a filter
constexpr int PRODUCTS = 9, TAPS = 9;  // see trunk_forward.h
constexpr int WIDE = REGISTERS / 16;   // vectors of positions computed together
constexpr uint8_t OFF = 4;             // in the place of a winner (0..3): ReLU is off

// A layer: its image, and the pooled outputs that are used, ROWS x COLUMNS. They are numbered along
// rows of PITCH and computed up to SIZE, so that no loop has a remainder. The surplus is not used.
template <int CHANNELS_, int IMAGE_PITCH_, int IMAGE_SIZE_, int FILTERS_, int GROUP_, int ROWS_,
          int COLUMNS_>
struct Layer {
    static constexpr int CHANNELS = CHANNELS_, IMAGE_PITCH = IMAGE_PITCH_, IMAGE_SIZE = IMAGE_SIZE_;
    static constexpr int FILTERS = FILTERS_, GROUP = GROUP_;  // GROUP filters computed together
    static constexpr int ROWS = ROWS_, COLUMNS = COLUMNS_, PITCH = COLUMNS + 2;
    static constexpr int SIZE = (ROWS * PITCH + 63) / 64 * 64, OUTPUTS = FILTERS * SIZE;
    static constexpr int PLANE = SIZE + 2 * PITCH + 2, PLANES = PRODUCTS * CHANNELS * PLANE;
    // A single channel has nothing to be paired with.
    template <typename Cell>
    using Fitting = std::conditional_t<CHANNELS % 2 == 0, Cell, float>;
    template <typename Cell>
    static constexpr int PACKED = std::is_same_v<Cell, float> ? 1 : 2;  // channels in a cell
    template <typename Cell>
    static constexpr int STACKS = CHANNELS / PACKED<Cell>;
    // Backward, channels are innermost; 6 are padded to 8, so that every second pixel is aligned.
    static constexpr int CELL = CHANNELS <= 2 ? CHANNELS : (CHANNELS + 7) / 8 * 8;
    static constexpr int WINDOW = SIDE * CELL;  // a row of a window
    static constexpr int PADDED_WINDOW = vectors(WINDOW) * LANES;
    static constexpr int LAST_WINDOW = (2 * ROWS - 1) * IMAGE_PITCH + 2 * COLUMNS - 1;
    static_assert((LAST_WINDOW + (SIDE - 1) * IMAGE_PITCH) * CELL + PADDED_WINDOW <=
                      IMAGE_SIZE * CELL,
                  "whole vectors must not leave the image");
};
// The second layer uses 19 of the first one's 20 rows.
template <int FRAMES>
using FirstLayer = Layer<FRAMES, 80, 45 * 80, 6, 6, 19, 37>;
using Second = Layer<6, FirstLayer<1>::PITCH, FirstLayer<1>::SIZE, 16, 8, 7, 16>;
constexpr int POOLED = Second::ROWS * Second::COLUMNS, FEATURES = Second::FILTERS * POOLED;

}  // namespace
