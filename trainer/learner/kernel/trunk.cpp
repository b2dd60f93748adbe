// The networks' trunk on the CPU: uint8 frames to 1,792 features, and the gradients of its weights.
//
//   frames [n, 45, 80] -> 6x6 convolution,  6 filters -> 2x2 max pooling, ReLU -> [6, 20, 37]
//                      -> 6x6 convolution, 16 filters -> 2x2 max pooling, ReLU -> [16, 7, 16]
//
// Images are independent tasks; gradients are summed in chunks of fixed size and then in order, so
// that no result depends on the number of threads.

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <type_traits>
#include <vector>

#if defined(__AVX512BF16__)
#include <immintrin.h>
#endif
#if defined(__AVX512BF16__) && defined(__AMX_TILE__) && defined(__AMX_BF16__) && defined(__linux__)
#define HAS_TILES
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace {

// Vectors, and the sizes of the networks' two layers.

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
constexpr int PRODUCTS = 9, TAPS = 9;  // see below
constexpr int WIDE = REGISTERS / 16;   // vectors of positions computed together
constexpr uint8_t OFF = 4;             // in the place of a winner (0..3): ReLU is off

// A layer: its image, and the pooled outputs that are used, ROWS x COLUMNS. Output (row, column)
// has the number row * PITCH + column, of SIZE, so that no loop has a remainder. Nobody reads the
// others.
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
// In reduced precision two channels' planes, and their weights, are rounded to bfloat16 and lie
// side by side in 32 bits, a pair: one instruction multiplies and adds both, in single precision.
// Where the processor has no such instruction, reduced precision is single precision. Where it has
// a matrix unit, too, there are no planes (ByTiles).

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

// Pools blocks of 2x2 outputs. As in torch, the first of equals wins.
inline void pool(const Vector (&block)[4], float bias, float* output, uint8_t* winner) {
    Vector best = block[0];
    Integers place = {};
    for (int next = 1; next < 4; ++next) {
        const Integers wins = block[next] > best;
        best = wins ? block[next] : best;
        place = wins ? Integers{} + next : place;
    }
    best += bias;
    const Integers on = best > Vector{};
    store(output, best < Vector{} ? Vector{} : best);  // not the mask: four NaN stay NaN
    *reinterpret_cast<LooseBytes*>(winner) =
        __builtin_convertvector(on ? place : Integers{} + OFF, Bytes);
}

// Adds up blocks of 2x2 outputs from their products, which lie ``stride`` apart.
inline void add_up(const float* products, int stride, Vector (&block)[4]) {
    Vector down[2][3];
    for (int right = 0; right < 3; ++right) {
        const Vector middle = load(products + (3 + right) * stride);
        down[0][right] = load(products + right * stride) + middle;
        down[1][right] = middle + load(products + (6 + right) * stride);
    }
    for (int i = 0; i < 4; ++i) block[i] = down[i / 2][i % 2] + down[i / 2][i % 2 + 1];
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
                    Vector block[4];
                    add_up(&products[0][filter][i], L::GROUP * TILE, block);
                    pool(block, bias[group + filter], outputs + at, winners + at);
                }
        }
}

// A layer by its planes.
template <class L, typename Number>
struct ByPlanes {
    using Cell = typename L::template Fitting<Number>;
    struct Scratch {
        Cell planes[L::PLANES];
    };
    const std::vector<Cell> weights;
    ByPlanes(const float* given, float scale) : weights(split_weights<L, Cell>(given, scale)) {}

    template <typename Pixel>
    void run(const Pixel* image, const float* bias, float* outputs, uint8_t* winners,
             Scratch& scratch) const {
        make_all_planes<L>(image, L::IMAGE_SIZE, scratch.planes);
        convolve<L>(scratch.planes, weights.data(), bias, outputs, winners);
    }
};
template <class L>
using Single = ByPlanes<L, float>;
template <class L>
using Paired = ByPlanes<L, Pair>;

#if defined(HAS_TILES)
// The system wants to be asked before a process uses the unit's registers.
inline bool tiles_permitted() {
    constexpr int REQUEST = 0x1023, TILE_DATA = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    static const bool permitted = syscall(SYS_arch_prctl, REQUEST, TILE_DATA) == 0;
    return permitted;
}

// GCC does not see which memory its tile instructions read: it may move a store past them.
inline void settle() { asm volatile("" ::: "memory"); }

struct Shape {
    uint8_t rows;
    uint16_t row_bytes;
};

// The tiles' shapes while this lives; then those from before, which may be another library's.
class Tiles {
    struct alignas(64) Shapes {
        uint8_t palette, start_row, reserved[14];
        uint16_t row_bytes[16];
        uint8_t rows[16];
    };
    Shapes before = {}, now = {};

public:
    explicit Tiles(const Shape (&shapes)[8]) {
        now.palette = 1;
        for (int tile = 0; tile < 8; ++tile) {
            now.rows[tile] = shapes[tile].rows;
            now.row_bytes[tile] = shapes[tile].row_bytes;
        }
        settle();
        _tile_storeconfig(&before);
        _tile_loadconfig(&now);
    }
    ~Tiles() { _tile_loadconfig(&before); }
};

// A layer by a processor's matrix unit (AMX), which multiplies tiles of 16 rows of 64 bytes so fast
// that planes would not pay. A tile of weights is [filter][column of the filter], one of the image
// [column of the filter][16 positions]. Each row of the latter begins a pixel after the one before:
// they overlap in memory, and nothing is copied.
template <class L>
struct ByTiles {
    static constexpr int STACKS = (L::CHANNELS + 1) / 2, ROW = L::FILTERS * SIDE;
    struct Scratch {
        Pair image[STACKS][L::IMAGE_SIZE];
        float sums[2][2][L::FILTERS][LANES];  // [row][right half][filter][position]
    };
    static constexpr int LAST_PAIR = (2 * L::ROWS + SIDE - 2) * L::IMAGE_PITCH +
                                     2 * vectors(L::COLUMNS) * LANES + SIDE - 2;
    static_assert(LAST_PAIR < L::IMAGE_SIZE, "tiles must not leave the image");
    static_assert((L::ROWS - 1) * L::PITCH + vectors(L::COLUMNS) * LANES <= L::SIZE,
                  "whole vectors must not leave the outputs");
    std::vector<Pair> weights;  // [stack][row of the filter][filter][column]

    ByTiles(const float* given, float scale) : weights(STACKS * SIDE * ROW) {
        for (int filter = 0; filter < L::FILTERS; ++filter)
            for (int pixel = 0; pixel < SIDE * SIDE; ++pixel, given += L::CHANNELS)
                for (int stack = 0; stack < STACKS; ++stack)
                    pack_channels(given, stack, 1, scale,
                                  &weights[(stack * SIDE + pixel / SIDE) * ROW + filter * SIDE +
                                           pixel % SIDE]);
    }

    template <typename Pixel>
    void run(const Pixel* image, const float* bias, float* outputs, uint8_t* winners,
             Scratch& scratch) const {
        for (int stack = 0; stack < STACKS; ++stack)
            for (int i = 0; i <= LAST_PAIR; ++i)
                pack_channels(image + i, stack, L::IMAGE_SIZE, 1.0f, &scratch.image[stack][i]);
        constexpr Shape SUMS = {L::FILTERS, 64}, PIXELS = {SIDE, 64};
        constexpr Shape WEIGHTS = {L::FILTERS, SIDE * sizeof(Pair)};
        const Tiles tiles({SUMS, SUMS, SUMS, SUMS, WEIGHTS, WEIGHTS, PIXELS, PIXELS});
        // Rows in order: what a vector writes behind its row is overwritten by the next.
        for (int row = 0; row < L::ROWS; ++row)
            for (int column = 0; column < L::COLUMNS; column += LANES) {
                multiply(&scratch.image[0][2 * row * L::IMAGE_PITCH + 2 * column], scratch.sums);
                for (int filter = 0; filter < L::FILTERS; ++filter) {
                    Vector block[4];
                    for (int i = 0; i < 4; ++i) {
                        const auto& halves = scratch.sums[i / 2];
                        block[i] = (Vector)_mm512_permutex2var_ps(load(halves[0][filter]),
                                                                  (__m512i)(EVEN + i % 2),
                                                                  load(halves[1][filter]));
                    }
                    const int at = filter * L::SIZE + row * L::PITCH + column;
                    pool(block, bias[filter], outputs + at, winners + at);
                }
            }
    }

private:
    static constexpr Integers EVEN = {0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30};

    // A single channel is paired with zeros.
    template <typename Number>
    static void pack_channels(const Number* from, int stack, int stride, float scale, Pair* to) {
        const bool whole = 2 * stack + 1 < L::CHANNELS;
        from += 2 * stack * stride;
        pack({from[0] * scale, whole ? from[stride] * scale : 0.0f}, to);
    }

    // Two rows of 32 outputs; ``image`` is where the first one's window begins.
    void multiply(const Pair* image, float (&sums)[2][2][L::FILTERS][LANES]) const {
        constexpr int PIXEL = sizeof(Pair), FILTER = SIDE * sizeof(Pair);
        settle();
        _tile_zero(0);
        _tile_zero(1);
        _tile_zero(2);
        _tile_zero(3);
        for (int stack = 0; stack < STACKS; ++stack)
            for (int row = 0; row <= SIDE; ++row) {
                const Pair* pixels = image + stack * L::IMAGE_SIZE + row * L::IMAGE_PITCH;
                const Pair* filters = &weights[stack * SIDE * ROW];
                _tile_loadd(6, pixels, PIXEL);
                _tile_loadd(7, pixels + LANES, PIXEL);
                if (row < SIDE) {
                    _tile_loadd(4, filters + row * ROW, FILTER);
                    _tile_dpbf16ps(0, 4, 6);
                    _tile_dpbf16ps(1, 4, 7);
                }
                if (row > 0) {
                    _tile_loadd(5, filters + (row - 1) * ROW, FILTER);
                    _tile_dpbf16ps(2, 5, 6);
                    _tile_dpbf16ps(3, 5, 7);
                }
            }
        _tile_stored(0, sums[0][0], 64);
        _tile_stored(1, sums[0][1], 64);
        _tile_stored(2, sums[1][0], 64);
        _tile_stored(3, sums[1][1], 64);
    }
};
#endif

// What a thread needs for one image, forward. It starts as zeros: unused positions may hold
// anything, but reading them should not meet slow denormal numbers.
template <int FRAMES, template <class> class Way>
struct ForwardScratch {
    using First = FirstLayer<FRAMES>;
    typename Way<First>::Scratch first;
    typename Way<Second>::Scratch second;
    float hidden[First::OUTPUTS], outputs[Second::OUTPUTS];
    uint8_t winners1[First::OUTPUTS], winners2[Second::OUTPUTS];
};

template <int FRAMES, template <class> class Way>
void forward(const uint8_t* frames, int64_t image_stride, int64_t images, const float* weights1,
             const float* bias1, const float* weights2, const float* bias2, float* features,
             float* hidden, uint8_t* winners1, uint8_t* winners2, int threads) {
    using First = FirstLayer<FRAMES>;
    const Way<First> first(weights1, 1.0f / 255.0f);
    const Way<Second> second(weights2, 1.0f);
#pragma omp parallel num_threads(threads) if (images > 1)
    {
        const auto scratch = std::make_unique<ForwardScratch<FRAMES, Way>>();
#pragma omp for schedule(dynamic)
        for (int64_t image = 0; image < images; ++image) {
            float* between = hidden ? hidden + image * First::OUTPUTS : scratch->hidden;
            uint8_t* won1 = hidden ? winners1 + image * First::OUTPUTS : scratch->winners1;
            uint8_t* won2 = hidden ? winners2 + image * Second::OUTPUTS : scratch->winners2;
            first.run(frames + image * image_stride, bias1, between, won1, scratch->first);
            second.run(between, bias2, scratch->outputs, won2, scratch->second);
            for (int row = 0; row < Second::FILTERS * Second::ROWS; ++row)
                std::copy_n(scratch->outputs + row / Second::ROWS * Second::SIZE +
                                row % Second::ROWS * Second::PITCH,
                            Second::COLUMNS, features + image * FEATURES + row * Second::COLUMNS);
        }
    }
}

// The gradients of features to those of the weights.
//
// A pooled output passes its gradient to one position of four, the winner, and to none where ReLU
// is off. What remains is a list of spikes: a gradient, and where the winner's window starts. The
// gradients of weights and inputs are sums over these lists.
//
// In reduced precision a matrix unit, where there is one, multiplies the spikes and all zeros
// between them, which is faster (BackByTiles). Factors are bfloat16, sums in single precision.

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

// Of one image: what its pass forward kept, and the gradients of its features.
struct Kept {
    const uint8_t* frames;
    const float* hidden;
    const uint8_t *winners1, *winners2;
    const float* gradients;
};

// Where gradients of weights stand while they are summed: in windows, channels innermost.
template <class L>
struct InWindows {
    static constexpr int SIZE = L::FILTERS * SIDE * L::PADDED_WINDOW;
    static int place(int filter, int row, int column, int channel) {
        return (filter * SIDE + row) * L::PADDED_WINDOW + column * L::CELL + channel;
    }
};

// Gradients of a layer's parameters.
template <class L, class Order>
struct Gradients {
    float weights[Order::SIZE], bias[L::FILTERS];

    void add(const Gradients& other) {
        for (int i = 0; i < Order::SIZE; ++i) weights[i] += other.weights[i];
        for (int filter = 0; filter < L::FILTERS; ++filter) bias[filter] += other.bias[filter];
    }

    void write(float scale, float* to_weights, float* to_bias) const {
        for (int row = 0; row < L::FILTERS * SIDE; ++row)
            for (int i = 0; i < SIDE * L::CHANNELS; ++i)
                *to_weights++ = weights[Order::place(row / SIDE, row % SIDE, i / L::CHANNELS,
                                                     i % L::CHANNELS)] *
                                scale;
        std::copy_n(bias, L::FILTERS, to_bias);
    }
};
template <int FRAMES, template <class> class Order>
struct Sums {
    Gradients<FirstLayer<FRAMES>, Order<FirstLayer<FRAMES>>> first;
    Gradients<Second, Order<Second>> second;
};

// The lists, one filter's at a time; channels are innermost.
template <int FRAMES>
struct BackBySpikes {
    using First = FirstLayer<FRAMES>;
    using Totals = Sums<FRAMES, InWindows>;
    struct Scratch {
        alignas(64) float image[First::IMAGE_SIZE * First::CELL];
        alignas(64) float hidden[First::SIZE * Second::CELL];
        alignas(64) float hidden_gradients[First::SIZE * Second::CELL];
        Spike spikes[First::SIZE];
    };
    std::vector<float> weights2;  // padded

    explicit BackBySpikes(const float* given) : weights2(InWindows<Second>::SIZE) {
        for (int pixel = 0; pixel < Second::FILTERS * SIDE * SIDE; ++pixel)
            std::copy_n(given + pixel * Second::CHANNELS, Second::CHANNELS,
                        &weights2[InWindows<Second>::place(0, pixel / SIDE, pixel % SIDE, 0)]);
    }

    void run(const Kept& kept, Scratch& scratch, Totals& sums) const {
        interleave<First>(kept.frames, scratch.image);
        interleave<Second>(kept.hidden, scratch.hidden);
        Spike* spikes = scratch.spikes;
        const auto sum = [spikes](int count) {
            float total = 0;
            for (int i = 0; i < count; ++i) total += spikes[i].gradient;
            return total;
        };
        std::fill_n(scratch.hidden_gradients, First::SIZE * Second::CELL, 0.0f);
        for (int filter = 0; filter < Second::FILTERS; ++filter) {
            const int count = list_spikes<Second>(kept.gradients + filter * POOLED, Second::COLUMNS,
                                                  1, kept.winners2 + filter * Second::SIZE, spikes);
            const int window = InWindows<Second>::place(filter, 0, 0, 0);
            add_windows<Second>(spikes, count, scratch.hidden, sums.second.weights + window);
            spread_spikes<Second>(spikes, count, &weights2[window], scratch.hidden_gradients);
            sums.second.bias[filter] += sum(count);
        }
        for (int filter = 0; filter < First::FILTERS; ++filter) {
            const int count = list_spikes<First>(
                scratch.hidden_gradients + filter, First::PITCH * Second::CELL, Second::CELL,
                kept.winners1 + filter * First::SIZE, spikes);
            add_windows<First>(spikes, count, scratch.image,
                               sums.first.weights + InWindows<First>::place(filter, 0, 0, 0));
            sums.first.bias[filter] += sum(count);
        }
    }
};

#if defined(HAS_TILES)
// Pairs of bfloat16, a vector of them. GCC converts bytes several times as slowly by itself.
typedef uint32_t Pairs __attribute__((vector_size(4 * LANES)));
constexpr Pairs NUMBERS = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
inline Pairs load(const Pair* from) { return (Pairs)_mm512_loadu_si512(from); }
inline void store(Pair* to, Pairs pairs) { _mm512_storeu_si512(to, (__m512i)pairs); }
inline Pairs widen(const uint8_t* from) {
    return (Pairs)_mm512_cvtepu8_epi32(_mm_loadu_si128((const __m128i*)from));
}
inline Vector load(const uint8_t* from) {
    return (Vector)_mm512_cvtepi32_ps((__m512i)widen(from));
}
inline Pairs rounded(Vector values) {  // in the lower halves
    return (Pairs)_mm512_cvtepu16_epi32((__m256i)_mm512_cvtneps_pbh((__m512)values));
}
inline void interleave(Pairs even, Pairs odd, Pair* to) {
    const Pairs half = NUMBERS / 2 + NUMBERS % 2 * LANES;
    for (int i = 0; i < 2; ++i, to += LANES)
        store(to, (Pairs)_mm512_permutex2var_epi32(
                      (__m512i)even, (__m512i)(half + i * LANES / 2), (__m512i)odd));
}

// As the matrix unit leaves them: a tile is [filter][column of the filter][channel of a stack], and
// the last four numbers of its rows are not used.
template <class L>
struct InTiles {
    static constexpr int STACKS = (L::CHANNELS + 1) / 2;
    static constexpr int TILE = L::FILTERS * LANES, SIZE = STACKS * SIDE * TILE;
    static int place(int filter, int row, int column, int channel) {
        return (channel / 2 * SIDE + row) * TILE + filter * LANES + column * 2 + channel % 2;
    }
};

// The operands of a layer's weight gradients: spikes and image as pairs of bfloat16.
template <class L>
struct Spread {
    static constexpr int MARGIN = SIDE - 1, WIDTH = vectors(L::COLUMNS) * LANES;
    static constexpr int STACKS = InTiles<L>::STACKS, TILE = InTiles<L>::TILE;
    // The spikes among zeros, and zeros above and below; a pair are neighbours in a row.
    alignas(64) Pair spikes[2 * L::ROWS + 2 * MARGIN][L::FILTERS][WIDTH];
    // The image; a pair are a pixel and the next one. A second channel that there is not is 0.
    alignas(64) Pair image[STACKS][L::IMAGE_SIZE][2];
    static constexpr int LAST_PIXEL =
        (2 * L::ROWS - 1 + MARGIN) * L::IMAGE_PITCH + 2 * (WIDTH - 1) + LANES / 2 - 1;
    static_assert((LAST_PIXEL / LANES + 1) * LANES < L::IMAGE_SIZE,
                  "whole vectors must not leave the image");

    template <typename Pixel>
    void take_image(const Pixel* pixels) {
        const auto pairs = [](const Pixel* at) {
            return rounded(load(at)) | rounded(load(at + 1)) << 16;
        };
        for (int stack = 0; stack < STACKS; ++stack, pixels += 2 * L::IMAGE_SIZE)
            for (int i = 0; i <= LAST_PIXEL; i += LANES) {
                const bool whole = 2 * stack + 1 < L::CHANNELS;
                interleave(pairs(pixels + i), whole ? pairs(pixels + L::IMAGE_SIZE + i) : Pairs{},
                           image[stack][i]);
            }
    }

    // Puts gradients [filter][row][PITCH] where their winners stand.
    template <int PITCH>
    void take_gradients(const float* gradients, const uint8_t* winners, float* bias) {
        for (int filter = 0; filter < L::FILTERS; ++filter) {
            Vector sum = {};
            for (int row = 0; row < L::ROWS; ++row)
                for (int column = 0; column < L::COLUMNS; column += LANES) {
                    const uint8_t* at = winners + filter * L::SIZE + row * L::PITCH + column;
                    const Pairs winner = NUMBERS + column < L::COLUMNS ? widen(at) : Pairs{} + OFF;
                    const Vector gradient =
                        load(gradients + (filter * L::ROWS + row) * PITCH + column);
                    const Pairs value = rounded(gradient);
                    Pair* to = &spikes[MARGIN + 2 * row][filter][column];
                    for (unsigned i = 0; i < 4; i += 2, to += L::FILTERS * WIDTH)
                        store(to, (winner == i ? value : Pairs{}) |
                                      (winner == i + 1 ? value << 16 : Pairs{}));
                    sum += winner == OFF ? Vector{} : gradient;
                }
            bias[filter] += _mm512_reduce_add_ps((__m512)sum);
        }
    }

    // Multiplies each row of the image by the six rows of spikes whose windows contain it, and adds
    // the products to the sums.
    void add_windows(float* sums) const {
        constexpr Shape SPIKES = {L::FILTERS, 64};
        const Tiles tiles({SPIKES, SPIKES, SPIKES, SPIKES, SPIKES, SPIKES, SPIKES, {LANES, 64}});
        for (int stack = 0; stack < STACKS; ++stack, sums += SIDE * TILE) {
            settle();
            _tile_loadd(0, sums, 64);
            _tile_loadd(1, sums + TILE, 64);
            _tile_loadd(2, sums + 2 * TILE, 64);
            _tile_loadd(3, sums + 3 * TILE, 64);
            _tile_loadd(4, sums + 4 * TILE, 64);
            _tile_loadd(5, sums + 5 * TILE, 64);
            for (int column = 0; column < L::COLUMNS; column += LANES)
                for (int row = 0; row < 2 * L::ROWS + MARGIN; ++row) {
                    constexpr int UP = L::FILTERS * WIDTH, ROW = WIDTH * sizeof(Pair);
                    const Pair* at = &spikes[MARGIN + row][0][column];
                    _tile_loadd(7, image[stack][row * L::IMAGE_PITCH + 2 * column],
                                4 * sizeof(Pair));
                    _tile_loadd(6, at, ROW);
                    _tile_dpbf16ps(0, 6, 7);
                    _tile_loadd(6, at - UP, ROW);
                    _tile_dpbf16ps(1, 6, 7);
                    _tile_loadd(6, at - 2 * UP, ROW);
                    _tile_dpbf16ps(2, 6, 7);
                    _tile_loadd(6, at - 3 * UP, ROW);
                    _tile_dpbf16ps(3, 6, 7);
                    _tile_loadd(6, at - 4 * UP, ROW);
                    _tile_dpbf16ps(4, 6, 7);
                    _tile_loadd(6, at - 5 * UP, ROW);
                    _tile_dpbf16ps(5, 6, 7);
                }
            _tile_stored(0, sums, 64);
            _tile_stored(1, sums + TILE, 64);
            _tile_stored(2, sums + 2 * TILE, 64);
            _tile_stored(3, sums + 3 * TILE, 64);
            _tile_stored(4, sums + 4 * TILE, 64);
            _tile_stored(5, sums + 5 * TILE, 64);
            settle();
        }
    }
};

template <int FRAMES>
struct BackByTiles {
    using First = FirstLayer<FRAMES>;
    using Totals = Sums<FRAMES, InTiles>;
    static constexpr int MARGIN = Spread<Second>::MARGIN, WIDTH = Spread<First>::WIDTH;
    static constexpr int SPIKES = 2 * Second::COLUMNS;
    struct Scratch {
        Spread<First> first;
        Spread<Second> second;
        // The second layer's spikes again; a pair are two filters.
        alignas(64) Pair spikes[2 * Second::ROWS + 2 * MARGIN][Second::FILTERS / 2][SPIKES];
        // A row of them times each column of the filters, with zeros to the left and right.
        alignas(64) float products[SIDE][Second::CHANNELS][LANES + SPIKES + LANES];
        alignas(64) float hidden_gradients[Second::CHANNELS][First::ROWS][WIDTH];
    };
    // A tile: two columns of the filters x 6 channels, by two rows of them x 16 filters. The odd
    // row comes first, since its spikes lie one row higher.
    alignas(64) Pair weights2[SIDE / 2][SIDE][Second::CHANNELS][2][Second::FILTERS / 2];

    explicit BackByTiles(const float* given) {
        const auto at = [given](int filter, int row, int column, int channel) {
            return given[((filter * SIDE + row) * SIDE + column) * Second::CHANNELS + channel];
        };
        for (int row = 0; row < SIDE; ++row)
            for (int column = 0; column < SIDE; ++column)
                for (int channel = 0; channel < Second::CHANNELS; ++channel)
                    for (int i = 0; i < Second::FILTERS; i += 2)
                        pack({at(i, row, column, channel), at(i + 1, row, column, channel)},
                             &weights2[row / 2][column][channel][1 - row % 2][i / 2]);
    }

    void run(const Kept& kept, Scratch& scratch, Totals& sums) const {
        scratch.second.take_image(kept.hidden);
        scratch.second.template take_gradients<Second::COLUMNS>(kept.gradients, kept.winners2,
                                                                sums.second.bias);
        scratch.second.add_windows(sums.second.weights);
        spread_back(scratch);
        scratch.first.take_image(kept.frames);
        scratch.first.template take_gradients<WIDTH>(&scratch.hidden_gradients[0][0][0],
                                                     kept.winners1, sums.first.bias);
        scratch.first.add_windows(sums.first.weights);
    }

private:
    // The gradients of the second layer's image: multiplies the spikes by each column of the
    // filters where they stand, and adds the six products, shifted.
    void spread_back(Scratch& scratch) const {
        static_assert(Second::COLUMNS == LANES);
        for (int row = MARGIN; row < MARGIN + 2 * Second::ROWS; ++row)
            for (int i = 0; i < Second::FILTERS / 2; ++i) {
                const Pairs even = load(scratch.second.spikes[row][2 * i]);
                const Pairs odd = load(scratch.second.spikes[row][2 * i + 1]);
                interleave((even & 0xffff) | odd << 16, even >> 16 | (odd & 0xffff0000),
                           scratch.spikes[row][i]);
            }
        constexpr Shape WEIGHTS = {2 * Second::CHANNELS, 64};
        const Tiles tiles(
            {WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS, {LANES, 64}});
        constexpr int PRODUCT = sizeof(scratch.products[0][0]);
        for (int row = 0; row < First::ROWS; ++row) {
            for (int column = 0; column < SPIKES; column += LANES) {
                settle();
                _tile_zero(0);
                _tile_zero(1);
                _tile_zero(2);
                for (int up = 0; up < SIDE; up += 2) {
                    _tile_loadd(7, &scratch.spikes[MARGIN + row - up - 1][0][column],
                                SPIKES * sizeof(Pair));
                    _tile_loadd(3, weights2[up / 2][0], 64);
                    _tile_loadd(4, weights2[up / 2][2], 64);
                    _tile_loadd(5, weights2[up / 2][4], 64);
                    _tile_dpbf16ps(0, 3, 7);
                    _tile_dpbf16ps(1, 4, 7);
                    _tile_dpbf16ps(2, 5, 7);
                }
                _tile_stored(0, &scratch.products[0][0][LANES + column], PRODUCT);
                _tile_stored(1, &scratch.products[2][0][LANES + column], PRODUCT);
                _tile_stored(2, &scratch.products[4][0][LANES + column], PRODUCT);
                settle();
            }
            for (int channel = 0; channel < Second::CHANNELS; ++channel)
                for (int column = 0; column < WIDTH; column += LANES) {
                    Vector sum = {};
                    for (int left = 0; left < SIDE; ++left)
                        sum += load(&scratch.products[left][channel][LANES + column - left]);
                    store(&scratch.hidden_gradients[channel][row][column], sum);
                }
        }
    }
};
#endif

constexpr int64_t CHUNK = 8;  // images that share their sums

template <int FRAMES, template <int> class Way>
void backward(const uint8_t* frames, int64_t image_stride, int64_t images, const float* weights2,
              const float* hidden, const uint8_t* winners1, const uint8_t* winners2,
              const float* gradients, float* to_weights1, float* to_bias1, float* to_weights2,
              float* to_bias2, int threads) {
    using Totals = typename Way<FRAMES>::Totals;
    constexpr int HIDDEN = FirstLayer<FRAMES>::OUTPUTS;
    const Way<FRAMES> way(weights2);
    std::vector<Totals> sums((images + CHUNK - 1) / CHUNK);
#pragma omp parallel num_threads(threads) if (images > CHUNK)
    {
        // Zeros, which margins and padding must stay: nobody writes there.
        const auto scratch = std::make_unique<typename Way<FRAMES>::Scratch>();
#pragma omp for schedule(dynamic)
        for (int64_t first = 0; first < images; first += CHUNK)
            for (int64_t image = first; image < std::min(images, first + CHUNK); ++image)
                way.run({frames + image * image_stride, hidden + image * HIDDEN,
                         winners1 + image * HIDDEN, winners2 + image * Second::OUTPUTS,
                         gradients + image * FEATURES},
                        *scratch, sums[first / CHUNK]);
    }
    Totals total = {};
    for (const Totals& part : sums) {
        total.first.add(part.first);
        total.second.add(part.second);
    }
    total.first.write(1.0f / 255.0f, to_weights1, to_bias1);
    total.second.write(1.0f, to_weights2, to_bias2);
}

}  // namespace

// Frames are [images][channels][45][80] with ``image_stride`` bytes between images and 1 or 2
// channels; weights and their gradients are [filter][6][6][channel]. What a backward pass will need
// is kept in hidden and winners1, trunk_hidden() numbers an image each, and in winners2,
// trunk_outputs() numbers an image. All three are null if no backward pass follows. ``reduced``
// asks for bfloat16; a backward pass has it by a matrix unit only.

extern "C" {

int trunk_hidden() { return FirstLayer<1>::OUTPUTS; }
int trunk_outputs() { return Second::OUTPUTS; }

// Whether ``reduced`` is bfloat16 here, and not single precision.
int trunk_has_bfloat16() { return !std::is_same_v<Pair, float>; }

// Whether a matrix unit multiplies it.
int trunk_has_tiles() {
#if defined(HAS_TILES)
    return tiles_permitted();
#else
    return 0;
#endif
}

void trunk_forward(const uint8_t* frames, int64_t image_stride, int64_t images, int channels,
                   const float* weights1, const float* bias1, const float* weights2,
                   const float* bias2, float* features, float* hidden, uint8_t* winners1,
                   uint8_t* winners2, int reduced, int threads) {
    auto run = channels == 1 ? (reduced ? forward<1, Paired> : forward<1, Single>)
                             : (reduced ? forward<2, Paired> : forward<2, Single>);
#if defined(HAS_TILES)
    if (reduced && trunk_has_tiles())
        run = channels == 1 ? forward<1, ByTiles> : forward<2, ByTiles>;
#endif
    run(frames, image_stride, images, weights1, bias1, weights2, bias2, features, hidden, winners1,
        winners2, threads);
}

void trunk_backward(const uint8_t* frames, int64_t image_stride, int64_t images, int channels,
                    const float* weights2, const float* hidden, const uint8_t* winners1,
                    const uint8_t* winners2, const float* gradients, float* to_weights1,
                    float* to_bias1, float* to_weights2, float* to_bias2, int reduced,
                    int threads) {
    auto run = channels == 1 ? backward<1, BackBySpikes> : backward<2, BackBySpikes>;
#if defined(HAS_TILES)
    if (reduced && trunk_has_tiles())
        run = channels == 1 ? backward<1, BackByTiles> : backward<2, BackByTiles>;
#endif
    run(frames, image_stride, images, weights2, hidden, winners1, winners2, gradients, to_weights1,
        to_bias1, to_weights2, to_bias2, threads);
}

}  // extern "C"
