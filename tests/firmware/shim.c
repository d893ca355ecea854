/* What the tests need beside the firmware's own interface: memory for a board, and looks inside. */
#include <stdlib.h>
#include <string.h>

#include "controller.h"

struct controller *board_new(uint32_t boot_id, uint8_t reset_cause, uint32_t now_ms) {
  struct controller *c = malloc(sizeof *c);
  if (c) {
    memset(c, 0xa5, sizeof *c); /* as memory is after power-on */
    controller_init(c, boot_id, reset_cause, now_ms);
  }
  return c;
}

void board_free(struct controller *c) { free(c); }

void board_feed(struct controller *c, const uint8_t *bytes, uint32_t count, uint32_t now_ms) {
  for (uint32_t i = 0; i < count; i++) {
    controller_receive(c, bytes[i], now_ms);
  }
}

uint32_t board_drain(struct controller *c, uint8_t *bytes, uint32_t size) {
  uint32_t count = 0;
  int16_t next;
  while (count < size && (next = controller_next_byte(c)) >= 0) {
    bytes[count++] = (uint8_t)next;
  }
  return count;
}

uint8_t board_state(const struct controller *c) { return c->state; }
uint16_t board_faults(const struct controller *c) { return c->faults; }
int16_t board_applied(const struct controller *c, uint8_t channel) { return c->output.applied[channel]; }
int16_t board_set_point(const struct controller *c, uint8_t channel) { return c->set_points[channel]; }
uint16_t board_rx_bad(const struct controller *c) { return c->rx_bad; }
