/* Functions for the tests: memory for a board, and access to its state. */
#include <stdlib.h>
#include <string.h>

#include "supervisor.h"

struct supervisor *board_new(uint32_t boot_id, uint8_t reset_cause, uint32_t now_ms) {
  struct supervisor *s = malloc(sizeof *s);
  if (s) {
    memset(s, 0xa5, sizeof *s); /* as memory is after power-on */
    supervisor_init(s, boot_id, reset_cause, now_ms);
  }
  return s;
}

void board_free(struct supervisor *s) { free(s); }

void board_feed(struct supervisor *s, const uint8_t *bytes, uint32_t count, uint32_t now_ms) {
  for (uint32_t i = 0; i < count; i++) {
    supervisor_receive(s, bytes[i], now_ms);
  }
}

uint32_t board_drain(struct supervisor *s, uint8_t *bytes, uint32_t size) {
  uint32_t count = 0;
  int16_t next;
  while (count < size && (next = supervisor_next_byte(s)) >= 0) {
    bytes[count++] = (uint8_t)next;
  }
  return count;
}

uint8_t board_state(const struct supervisor *s) { return s->state; }
uint16_t board_faults(const struct supervisor *s) { return s->faults; }
int16_t board_applied(const struct supervisor *s, uint8_t channel) { return s->output.applied[channel]; }
int16_t board_set_point(const struct supervisor *s, uint8_t channel) { return s->set_points[channel]; }
uint16_t board_rx_bad(const struct supervisor *s) { return s->rx_bad; }
