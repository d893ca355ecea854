#include "output.h"

#include <string.h>

#include "limits.h"
#include "pins.h"

#define STALL_MS 20

#define SMALLER(a, b) ((a) < (b) ? (a) : (b))
#define LARGER(a, b) ((a) > (b) ? (a) : (b))

void output_step(struct output_stage *stage, const int16_t targets[PROTOCOL_CHANNELS], uint32_t elapsed_ms) {
  /* A stall of the loop counts as STALL_MS at most, so that no output jumps after it. */
  uint32_t budget = SLEW * SMALLER(elapsed_ms, STALL_MS) + stage->remainder;
  int16_t step = (int16_t)(budget / 1000);
  stage->remainder = (uint16_t)(budget % 1000);

  for (uint8_t channel = 0; channel < CHANNELS_USED; channel++) {
    int16_t target = LARGER(SMALLER(targets[channel], P_MAX), 0);
    int16_t least = (int16_t)(stage->applied[channel] - step);
    int16_t most = (int16_t)(stage->applied[channel] + step);
    stage->applied[channel] = LARGER(SMALLER(target, most), least);
  }
}

void output_dump(struct output_stage *stage) { memset(stage->applied, 0, sizeof stage->applied); }

bool output_is_vented(const struct output_stage *stage) {
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    if (stage->applied[channel] != 0) {
      return false;
    }
  }
  return true;
}

uint16_t output_counts(const struct output_stage *stage, uint8_t channel) {
  /* applied * PWM_COUNTS / P_FULL, rounded, with 16 fractional bits: a multiplication, because twelve 32-bit
   * divisions take half a millisecond. */
  const uint32_t counts_per_unit = ((PWM_COUNTS << 16) + P_FULL / 2) / P_FULL;
  const uint32_t half = 1UL << 15;
  return (uint16_t)(((uint32_t)stage->applied[channel] * counts_per_unit + half) >> 16);
}
