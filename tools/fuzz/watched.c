#include "watched.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "limits.h"
#include "pins.h"

#define STALL_MS 20 /* longest elapsed time that counts, see output.c */

static void must(const struct watched *w, bool holds, const char *rule) {
  if (!holds) {
    fprintf(stderr, "rule violated at %u ms in state %u, faults %u: %s\n", (unsigned)w->now_ms, w->board.state,
            w->board.faults, rule);
    abort();
  }
}

void watched_follow(struct watched *w, bool follow) {
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    bool sensed = (SENSORS >> channel) & 1;
    w->measured[channel] = !sensed ? PROTOCOL_NOT_MEASURED : follow ? w->board.output.applied[channel] : 0;
  }
}

void watched_begin(struct watched *w, uint32_t now_ms) {
  memset(w, 0, sizeof *w);
  memset(&w->board, 0xa5, sizeof w->board); /* as memory is after power-on */
  w->now_ms = now_ms;
  supervisor_init(&w->board, BOOT_ID, RESET_CAUSE_POWER_ON, now_ms);
  watched_follow(w, false);
  watched_pass(w, 0);
}

bool watched_receive(struct watched *w, uint8_t byte) { return supervisor_receive(&w->board, byte, w->now_ms); }

void watched_pass(struct watched *w, uint32_t elapsed_ms) {
  struct supervisor *board = &w->board;
  const int16_t *now = board->output.applied;
  int16_t before[PROTOCOL_CHANNELS];
  int32_t step = (int32_t)(SLEW * (elapsed_ms < STALL_MS ? elapsed_ms : STALL_MS) / 1000);
  must(w, !memcmp(now, w->applied, sizeof w->applied) || output_is_vented(&board->output),
       "a frame changed an output to a value other than 0");
  memcpy(before, now, sizeof before);
  w->now_ms += elapsed_ms;
  must(w, supervisor_update(board, w->measured, 5000, w->now_ms) == CHECK_UPDATE, "a pass skipped a check");

  bool running = board->state == STATE_RUNNING;
  must(w, (board->state == STATE_FAULT) == (board->faults != 0), "a fault outside FAULT, or FAULT without a fault");
  must(w, !(board->faults & FAULT_OVER_PRESSURE) || output_is_vented(&board->output), "over-pressure without a dump");
  if (running || board->state == STATE_ARMED) {
    must(w, w->now_ms - board->last_valid_ms <= LINK_TIMEOUT_MS, "a session without a host");
  }
  if (running) {
    must(w, w->now_ms - board->last_progress_ms <= CONTROL_TIMEOUT_MS, "RUNNING without a control loop");
  }
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    int32_t was = before[channel], is = now[channel];
    bool driven = running && (board->channels >> channel & 1);
    must(w, is >= 0 && is <= P_MAX, "an output outside its limits");
    must(w, channel < CHANNELS_USED || is == 0, "an output of an unused channel");
    must(w, is <= was + step + 1, "an output rises faster than SLEW");
    must(w, is == 0 || is >= was - step - 1, "an output falls faster than SLEW to a value other than 0");
    must(w, driven || is <= (was > step ? was - step : 0), "an output that is not driven does not vent");
    must(w,
         supervisor_counts(board, channel) <= PWM_COUNTS * P_MAX / P_FULL + 1 &&
             (is != 0 || supervisor_counts(board, channel) == 0),
         "counts that differ from the output");
  }
  memcpy(w->applied, now, sizeof w->applied);
}

void watched_send(struct watched *w, uint8_t type, uint8_t seq, uint8_t session, const void *payload, uint8_t length) {
  uint8_t bytes[FRAME_MAX_ENCODED];
  uint8_t count = frame_encode(bytes, type, seq, session, payload, length);
  for (uint8_t i = 0; i < count; i++) {
    watched_receive(w, bytes[i]);
  }
}

void watched_run(struct watched *w, int16_t pressure) {
  struct supervisor *board = &w->board;
  struct vent dump = {VENT_MODE_DUMP};
  struct clear_fault clear;
  struct heartbeat heartbeat = {board->tick};
  struct arm arm = {PROTOCOL_HASH, BOOT_ID, (uint8_t)(board->session == 255 ? 1 : board->session + 1),
                    (1 << CHANNELS_USED) - 1, P_FULL};
  struct set set = {board->tick, {0}};
  watched_send(w, MESSAGE_VENT, 0, 0, &dump, sizeof dump);
  watched_follow(w, false);
  watched_pass(w, 1);
  clear.mask = board->faults;
  watched_send(w, MESSAGE_CLEAR_FAULT, 0, 0, &clear, sizeof clear);
  for (uint8_t i = 0; i <= PROTOCOL_ARM_AFTER_MS / PROTOCOL_HEARTBEAT_PERIOD_MS; i++) {
    watched_send(w, MESSAGE_HEARTBEAT, 0, board->session, &heartbeat, sizeof heartbeat);
    watched_pass(w, PROTOCOL_HEARTBEAT_PERIOD_MS);
  }
  watched_send(w, MESSAGE_ARM, 0, board->session, &arm, sizeof arm);
  for (uint8_t channel = 0; channel < CHANNELS_USED; channel++) {
    set.pressures[channel] = pressure;
  }
  watched_send(w, MESSAGE_SET, 1, board->session, &set, sizeof set);
  must(w, board->state == STATE_RUNNING, "a correct host cannot start a session");
}
