// The networks' trunk on the CPU: uint8 frames to 1,792 features, and the gradients of its weights.
//
//   frames [n, 45, 80] -> 6x6 convolution,  6 filters -> 2x2 max pooling, ReLU -> [6, 20, 37]
//                      -> 6x6 convolution, 16 filters -> 2x2 max pooling, ReLU -> [16, 7, 16]
//
// How is told in trunk_forward.h and trunk_backward.h.
//
// Images are independent tasks; gradients are summed in chunks of fixed size and then in order, so
// that no result depends on the number of threads.

#include <cstdint>
#include <type_traits>

#include "trunk_backward.h"
#include "trunk_forward.h"
#include "trunk_layers.h"

// Frames are [images][channels][45][80] with ``image_stride`` bytes between images and 1 or 2
// channels; weights and their gradients are [filter][6][6][channel]. What a backward pass will need
// is kept in hidden and winners1, trunk_hidden() numbers an image each, and in winners2,
// trunk_outputs() numbers an image. All three are null if there will be none. ``reduced`` asks the
// forward pass for bfloat16.

extern "C" {

int trunk_hidden() { return FirstLayer<1>::OUTPUTS; }
int trunk_outputs() { return Second::OUTPUTS; }

// Whether ``reduced`` is bfloat16 here, and not single precision.
int trunk_has_bfloat16() { return !std::is_same_v<Pair, float>; }

void trunk_forward(const uint8_t* frames, int64_t image_stride, int64_t images, int channels,
                   const float* weights1, const float* bias1, const float* weights2,
                   const float* bias2, float* features, float* hidden, uint8_t* winners1,
                   uint8_t* winners2, int reduced, int threads) {
    const auto run = channels == 1 ? (reduced ? forward<1, Pair> : forward<1, float>)
                                   : (reduced ? forward<2, Pair> : forward<2, float>);
    run(frames, image_stride, images, weights1, bias1, weights2, bias2, features, hidden, winners1,
        winners2, threads);
}

void trunk_backward(const uint8_t* frames, int64_t image_stride, int64_t images, int channels,
                    const float* weights2, const float* hidden, const uint8_t* winners1,
                    const uint8_t* winners2, const float* gradients, float* to_weights1,
                    float* to_bias1, float* to_weights2, float* to_bias2, int threads) {
    const auto run = channels == 1 ? backward<1> : backward<2>;
    run(frames, image_stride, images, weights2, hidden, winners1, winners2, gradients, to_weights1,
        to_bias1, to_weights2, to_bias2, threads);
}

}  // extern "C"
