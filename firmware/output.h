/* The output stage: clamp, slew limit, pressure to PWM counts. No other code sets the output of a valve. */
#ifndef OUTPUT_H
#define OUTPUT_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

struct output_stage {
  int16_t applied[PROTOCOL_CHANNELS]; /* 10 Pa, present command of the valves */
  uint16_t remainder;                 /* part of a slew step not yet used, 10 Pa / 1000 */
};

/* Moves every channel towards its target, clamped to 0 .. P_MAX, by no more than the slew limit allows in elapsed_ms.
 * Channels from CHANNELS_USED on stay at 0. */
void output_step(struct output_stage *stage, const int16_t targets[PROTOCOL_CHANNELS], uint32_t elapsed_ms);

/* All channels to 0 at once. */
void output_dump(struct output_stage *stage);

/* True where every channel is at 0. */
bool output_is_vented(const struct output_stage *stage);

/* PWM counts, 0 to PWM_COUNTS, of a channel; at 0 the pin is disconnected. */
uint16_t output_counts(const struct output_stage *stage, uint8_t channel);

#ifdef __cplusplus
}
#endif
#endif
