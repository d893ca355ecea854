#include "output.h"

#include <string.h>

#include "limits.h"
#include "pins.h"

void output_step(struct output_stage *stage, const int16_t targets[PROTOCOL_CHANNELS], uint32_t elapsed_ms) {
  /* After a stall the outputs go on from where they are instead of leaping. */
  uint32_t budget = SLEW * (elapsed_ms < 20 ? elapsed_ms : 20) + stage->remainder;
  int16_t step = (int16_t)(budget / 1000);
  stage->remainder = (uint16_t)(budget % 1000);

  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    int16_t target = targets[channel];
    int16_t applied = stage->applied[channel];
    if (target < 0 || channel >= CHANNELS_USED) {
      target = 0;
    } else if (target > P_MAX) {
      target = P_MAX;
    }
    if (target > applied) {
      applied = target - applied > step ? (int16_t)(applied + step) : target;
    } else {
      applied = applied - target > step ? (int16_t)(applied - step) : target;
    }
    stage->applied[channel] = applied;
  }
}

void output_dump(struct output_stage *stage) { memset(stage->applied, 0, sizeof stage->applied); }

uint8_t output_is_vented(const struct output_stage *stage) {
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    if (stage->applied[channel] != 0) {
      return 0;
    }
  }
  return 1;
}

uint16_t output_counts(const struct output_stage *stage, uint8_t channel) {
  /* applied * PWM_COUNTS / P_FULL, rounded, as a multiplication: twelve 32-bit divisions take half a millisecond. */
  const uint32_t counts_per_unit = (PWM_COUNTS * 65536UL + P_FULL / 2) / P_FULL;
  return (uint16_t)(((uint32_t)stage->applied[channel] * counts_per_unit + 32768UL) >> 16);
}
