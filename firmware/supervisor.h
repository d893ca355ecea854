/* The state machine of the board: states, timers, faults. Plain C that uses no clock, port or pin, so that the same
 * source runs in the tests and in the emulated boards; firmware.ino connects it to the hardware.
 *
 *   BOOT -> IDLE -ARM-> ARMED -first SET-> RUNNING -VENT-> IDLE
 *   any  -> FAULT (latched, vents) -CLEAR_FAULT with exactly these faults, pressures down-> IDLE
 *
 * Outputs follow the set-points only in RUNNING; in every other state their target is 0. */
#ifndef SUPERVISOR_H
#define SUPERVISOR_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"
#include "output.h"
#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Each check of a pass sets its bit when it ends. Only a pass with all bits feeds the hardware watchdog. */
enum check {
  CHECK_LINK = 1,
  CHECK_CONTROL = 2,
  CHECK_SENSORS = 4,
  CHECK_SUPPLY = 8,
  CHECK_OUTPUTS = 16,
  CHECK_UPDATE = 31, /* those of supervisor_update */
  CHECK_ADC = 32,    /* the sketch's: the converter delivers readings */
  CHECK_PINS = 64,   /* the sketch's: every pin has its counts */
  CHECK_ALL = 127
};

struct supervisor {
  uint8_t state;   /* enum state */
  uint16_t faults; /* enum fault, latched */
  uint32_t boot_id;
  uint8_t reset_cause;
  uint32_t now_ms; /* of the last update */

  uint8_t session;   /* the last one armed; 0 before the first */
  uint16_t channels; /* bit c: this session drives channel c */
  uint8_t last_seq;  /* of the last SET accepted; in ARMED of the ARM */
  uint32_t tick;     /* counter of the host's control loop, last value received */
  uint32_t set_tick; /* of the last SET accepted */
  int16_t set_points[PROTOCOL_CHANNELS];

  bool heartbeats_heard;
  uint32_t heartbeats_since_ms; /* start of the unbroken series */
  uint32_t last_heartbeat_ms;
  uint32_t last_valid_ms;    /* last frame that feeds the link timer */
  uint32_t last_progress_ms; /* last frame with a later tick */

  int16_t measured[PROTOCOL_CHANNELS];
  uint16_t over_ms[PROTOCOL_CHANNELS];                               /* time above P_OVER */
  uint16_t above_ms[PROTOCOL_CHANNELS], below_ms[PROTOCOL_CHANNELS]; /* time P_DISAGREE off the applied pressure */
  uint16_t implausible_ms[PROTOCOL_CHANNELS];                        /* time outside the sensor's range */
  uint16_t supply_mv;
  uint16_t supply_low_ms; /* time below SUPPLY_LEAST_MV */

  struct output_stage output;
  struct frame_parser parser;
  uint16_t rx_good, rx_bad, rx_refused;

  uint32_t last_status_ms;
  uint8_t tx_seq;
  uint8_t tx[256]; /* ring buffer; its 8-bit indices wrap at its size */
  uint8_t tx_head, tx_tail;
};

/* Starts in BOOT, vented, with HELLO in the queue. */
void supervisor_init(struct supervisor *s, uint32_t boot_id, uint8_t reset_cause, uint32_t now_ms);

/* Takes one byte from the host. Returns true when it ends a valid frame, which then has been executed or refused. */
bool supervisor_receive(struct supervisor *s, uint8_t byte, uint32_t now_ms);

/* Once per loop: timers, faults, outputs, STATUS. measured is in 10 Pa, PROTOCOL_NOT_MEASURED where there is no sensor.
 * Returns the bits of its checks, CHECK_UPDATE. */
uint8_t supervisor_update(struct supervisor *s, const int16_t measured[PROTOCOL_CHANNELS], uint16_t supply_mv,
                          uint32_t now_ms);

/* PWM counts of a channel, see output.h. */
uint16_t supervisor_counts(const struct supervisor *s, uint8_t channel);

/* Next byte for the host, or -1. A frame that does not fit the queue is dropped whole: the board never waits. */
int16_t supervisor_next_byte(struct supervisor *s);

#ifdef __cplusplus
}
#endif
#endif
