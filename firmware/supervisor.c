/* More than 300 lines: every transition of the state machine is in one file, where it can be checked at a glance. */
#include "supervisor.h"

#include <string.h>

#include "limits.h"
#include "pins.h"

static bool in_session(const struct supervisor *s) { return s->state == STATE_ARMED || s->state == STATE_RUNNING; }

/* ---- To the host ------------------------------------------------------------------------------------------- */

static void send(struct supervisor *s, uint8_t type, const void *payload, uint8_t length) {
  uint8_t encoded[FRAME_MAX_ENCODED];
  uint8_t head = s->tx_head;
  uint8_t room = (uint8_t)(s->tx_tail - head - 1); /* a full ring would look like an empty one */
  if (FRAME_ENCODED_LENGTH(length) > room) {
    return; /* checked before the encoding: a host may ask for more answers than the port can send */
  }
  uint16_t to_end = (uint16_t)(sizeof s->tx - head);
  uint8_t size = frame_encode(encoded, type, s->tx_seq++, s->session, payload, length);
  uint8_t first = size < to_end ? size : (uint8_t)to_end;
  memcpy(s->tx + head, encoded, first);
  memcpy(s->tx, encoded + first, (uint8_t)(size - first));
  s->tx_head = (uint8_t)(head + size);
}

static void send_hello(struct supervisor *s) {
  struct hello hello;
  hello.protocol_hash = PROTOCOL_HASH;
  hello.firmware_version = FIRMWARE_VERSION;
  hello.boot_id = s->boot_id;
  hello.reset_cause = s->reset_cause;
  hello.channels = CHANNELS_USED;
  hello.sensors = SENSORS;
  hello.p_min = P_MIN;
  hello.p_max = P_MAX;
  hello.p_down = P_DOWN;
  hello.p_full = P_FULL;
  hello.sensor_zero_mv = SENSOR_ZERO_MV;
  hello.sensor_full_mv = SENSOR_FULL_MV;
  hello.sensor_full = SENSOR_FULL;
  hello.supply_least_mv = SUPPLY_LEAST_MV;
  hello.slew = SLEW;
  hello.link_timeout_ms = LINK_TIMEOUT_MS;
  hello.control_timeout_ms = CONTROL_TIMEOUT_MS;
  send(s, MESSAGE_HELLO, &hello, sizeof hello);
}

static void send_status(struct supervisor *s) {
  struct status status;
  status.acked_seq = s->last_seq;
  status.state = s->state;
  status.faults = s->faults;
  status.boot_id = s->boot_id;
  status.uptime_ms = s->now_ms;
  status.tick = s->tick;
  memcpy(status.applied, s->output.applied, sizeof status.applied);
  memcpy(status.measured, s->measured, sizeof status.measured);
  status.rx_good = s->rx_good;
  status.rx_bad = s->rx_bad;
  status.rx_refused = s->rx_refused;
  status.supply_mv = s->supply_mv;
  send(s, MESSAGE_STATUS, &status, sizeof status);
}

static void refuse(struct supervisor *s, const struct frame *frame, enum nack_reason reason) {
  struct nack nack = {frame->type, frame->seq, (uint8_t)reason};
  s->rx_refused++;
  send(s, MESSAGE_NACK, &nack, sizeof nack);
}

/* ---- States ------------------------------------------------------------------------------------------------ */

static void latch(struct supervisor *s, uint16_t fault) {
  s->faults |= fault;
  s->state = STATE_FAULT;
  if (fault & FAULT_OVER_PRESSURE) {
    output_dump(&s->output);
  }
}

static bool pressures_down(const struct supervisor *s) {
  if (!output_is_vented(&s->output)) {
    return false;
  }
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    if (s->measured[channel] >= P_DOWN) { /* "not measured" is the most negative number there is */
      return false;
    }
  }
  return true;
}

static void feed_link(struct supervisor *s, uint32_t now_ms) { s->last_valid_ms = now_ms; }

static void feed_control(struct supervisor *s, uint32_t tick, uint32_t now_ms) {
  if ((int32_t)(tick - s->tick) > 0) {
    s->tick = tick;
    s->last_progress_ms = now_ms;
  }
}

/* ---- From the host: each function takes a frame of the right length ------------------------------------------ */

static void on_hello_req(struct supervisor *s, const struct frame *frame) {
  struct hello_req request;
  memcpy(&request, frame->payload, sizeof request);
  send_hello(s); /* always: a host with another protocol identifies the board by it */
  if (request.protocol_hash != PROTOCOL_HASH) {
    refuse(s, frame, NACK_REASON_HASH);
  }
}

static void on_arm(struct supervisor *s, const struct frame *frame, uint32_t now_ms) {
  struct arm arm;
  memcpy(&arm, frame->payload, sizeof arm);
  if (arm.protocol_hash != PROTOCOL_HASH) {
    refuse(s, frame, NACK_REASON_HASH);
    return;
  }
  if (arm.boot_id == s->boot_id && s->state == STATE_ARMED && arm.new_session == s->session) {
    send_status(s); /* repeated, because the answer to the first one was lost */
    return;
  }
  if (arm.boot_id != s->boot_id || arm.new_session != (s->session == 255 ? 1 : s->session + 1)) {
    refuse(s, frame, NACK_REASON_SESSION);
    return;
  }
  if (s->state != STATE_IDLE || !output_is_vented(&s->output) || !s->heartbeats_heard ||
      now_ms - s->last_heartbeat_ms > LINK_TIMEOUT_MS || now_ms - s->heartbeats_since_ms < PROTOCOL_ARM_AFTER_MS) {
    refuse(s, frame, NACK_REASON_STATE);
    return;
  }
  if ((arm.channels >> CHANNELS_USED) != 0 || arm.p_full != P_FULL) {
    refuse(s, frame, NACK_REASON_RANGE);
    return;
  }
  if (!pressures_down(s)) {
    refuse(s, frame, NACK_REASON_PRESSURE);
    return;
  }
  s->state = STATE_ARMED;
  s->session = arm.new_session;
  s->channels = arm.channels;
  s->last_seq = frame->seq;
  s->set_tick = s->tick;
  feed_link(s, now_ms);
  send_status(s);
}

static void on_set(struct supervisor *s, const struct frame *frame, uint32_t now_ms) {
  struct set set;
  uint8_t ahead = (uint8_t)(frame->seq - s->last_seq);
  memcpy(&set, frame->payload, sizeof set);
  if (!in_session(s)) {
    refuse(s, frame, NACK_REASON_STATE);
    return;
  }
  if (frame->session != s->session) {
    refuse(s, frame, NACK_REASON_SESSION);
    return;
  }
  if (ahead == 0 && s->state == STATE_RUNNING) {
    send_status(s); /* a duplicate: acknowledged again, not applied again; it feeds no timer */
    return;
  }
  if (ahead == 0 || ahead > PROTOCOL_SEQUENCE_WINDOW || (int32_t)(set.tick - s->set_tick) < 0) {
    refuse(s, frame, NACK_REASON_SEQUENCE);
    return;
  }
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    int16_t pressure = set.pressures[channel];
    if (pressure < 0 || pressure > P_MAX || (pressure != 0 && !((s->channels >> channel) & 1))) {
      refuse(s, frame, NACK_REASON_RANGE); /* the whole frame is refused */
      return;
    }
  }
  memcpy(s->set_points, set.pressures, sizeof s->set_points);
  s->last_seq = frame->seq;
  s->set_tick = set.tick;
  if (s->state == STATE_ARMED) {
    s->state = STATE_RUNNING;
    s->last_progress_ms = now_ms;
  }
  feed_link(s, now_ms);
  feed_control(s, set.tick, now_ms);
  send_status(s);
}

static void on_heartbeat(struct supervisor *s, const struct frame *frame, uint32_t now_ms) {
  struct heartbeat heartbeat;
  memcpy(&heartbeat, frame->payload, sizeof heartbeat);
  if (in_session(s)) {
    if (frame->session != s->session) {
      refuse(s, frame, NACK_REASON_SESSION);
      return;
    }
    feed_link(s, now_ms);
    feed_control(s, heartbeat.tick, now_ms);
  } else {
    s->tick = heartbeat.tick; /* a new host may start to count anywhere */
  }
  if (!s->heartbeats_heard || now_ms - s->last_heartbeat_ms > LINK_TIMEOUT_MS) {
    s->heartbeats_since_ms = now_ms;
    s->heartbeats_heard = true;
  }
  s->last_heartbeat_ms = now_ms;
}

static void on_vent(struct supervisor *s, const struct frame *frame) {
  struct vent vent;
  memcpy(&vent, frame->payload, sizeof vent);
  if (in_session(s)) {
    s->state = STATE_IDLE;
  }
  if (vent.mode != VENT_MODE_RAMP) { /* an unknown mode dumps: that is the safe choice */
    output_dump(&s->output);
  }
  send_status(s);
}

static void on_clear_fault(struct supervisor *s, const struct frame *frame) {
  struct clear_fault clear;
  memcpy(&clear, frame->payload, sizeof clear);
  if (s->state != STATE_FAULT || !pressures_down(s)) {
    refuse(s, frame, NACK_REASON_STATE);
    return;
  }
  if (clear.mask != s->faults) {
    refuse(s, frame, NACK_REASON_RANGE);
    return;
  }
  s->faults = 0;
  s->state = STATE_IDLE;
  send_status(s);
}

static void on_frame(struct supervisor *s, const struct frame *frame, uint32_t now_ms) {
  int16_t expected = protocol_payload_length(frame->type);
  if (expected < 0) {
    refuse(s, frame, NACK_REASON_TYPE);
    return;
  }
  if (frame->length != expected) {
    refuse(s, frame, NACK_REASON_LENGTH);
    return;
  }
  switch (frame->type) {
    case MESSAGE_HELLO_REQ:
      on_hello_req(s, frame);
      break;
    case MESSAGE_ARM:
      on_arm(s, frame, now_ms);
      break;
    case MESSAGE_SET:
      on_set(s, frame, now_ms);
      break;
    case MESSAGE_HEARTBEAT:
      on_heartbeat(s, frame, now_ms);
      break;
    case MESSAGE_VENT:
      on_vent(s, frame);
      break;
    default: /* MESSAGE_CLEAR_FAULT: every other type was refused above */
      on_clear_fault(s, frame);
  }
}

/* ---- Checks, once a pass -------------------------------------------------------------------------------------- */

static uint8_t check_link(struct supervisor *s, uint32_t now_ms) {
  if (in_session(s) && now_ms - s->last_valid_ms > LINK_TIMEOUT_MS) {
    latch(s, FAULT_LINK_TIMEOUT);
  }
  return CHECK_LINK;
}

static uint8_t check_control(struct supervisor *s, uint32_t now_ms) {
  if (s->state == STATE_RUNNING && now_ms - s->last_progress_ms > CONTROL_TIMEOUT_MS) {
    latch(s, FAULT_CONTROL_TIMEOUT);
  }
  return CHECK_CONTROL;
}

/* Counts how long a condition holds; returns true once it holds for limit_ms. The count wraps after 65 s, when the
 * fault has long been latched. */
static bool lasts(uint16_t *counted_ms, bool condition, uint32_t elapsed_ms, uint16_t limit_ms) {
  uint32_t lasted_ms = condition ? *counted_ms + elapsed_ms : 0;
  *counted_ms = (uint16_t)lasted_ms;
  return lasted_ms >= limit_ms;
}

static uint8_t check_sensors(struct supervisor *s, uint32_t elapsed_ms) {
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    int32_t measured = s->measured[channel];
    int32_t difference;
    bool driven;
    if (measured == PROTOCOL_NOT_MEASURED) {
      continue;
    }
    if (lasts(&s->over_ms[channel], measured > P_OVER, elapsed_ms, OVER_PRESSURE_MS)) {
      latch(s, FAULT_OVER_PRESSURE); /* in any state */
    }
    if (lasts(&s->implausible_ms[channel], measured < SENSOR_LEAST || measured > SENSOR_MOST, elapsed_ms, SENSOR_MS)) {
      latch(s, FAULT_SENSOR); /* in any state: a broken wire is found before arming */
    }
    difference = measured - s->output.applied[channel];
    driven = s->state == STATE_RUNNING && ((s->channels >> channel) & 1);
    if (lasts(&s->above_ms[channel], driven && difference > P_DISAGREE, elapsed_ms, DISAGREE_MS)) {
      latch(s, FAULT_SENSOR);
    }
    if (lasts(&s->below_ms[channel], driven && difference < -P_DISAGREE, elapsed_ms, DISAGREE_MS)) {
      latch(s, FAULT_LEAK);
    }
  }
  return CHECK_SENSORS;
}

/* A sagging supply lowers every valve's command in proportion, so a ramp is safe. A supply that is not measured (0)
 * counts as too low. */
static uint8_t check_supply(struct supervisor *s, uint32_t elapsed_ms) {
  if (lasts(&s->supply_low_ms, s->supply_mv < SUPPLY_LEAST_MV, elapsed_ms, SUPPLY_MS)) {
    latch(s, FAULT_SUPPLY); /* in any state */
  }
  return CHECK_SUPPLY;
}

static uint8_t drive_outputs(struct supervisor *s, uint32_t elapsed_ms) {
  static const int16_t vented[PROTOCOL_CHANNELS];
  output_step(&s->output, s->state == STATE_RUNNING ? s->set_points : vented, elapsed_ms);
  return CHECK_OUTPUTS;
}

/* ---- Interface ------------------------------------------------------------------------------------------------- */

void supervisor_init(struct supervisor *s, uint32_t boot_id, uint8_t reset_cause, uint32_t now_ms) {
  memset(s, 0, sizeof *s);
  s->state = STATE_BOOT;
  s->boot_id = boot_id;
  s->reset_cause = reset_cause;
  s->now_ms = now_ms;
  s->last_status_ms = now_ms;
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    s->measured[channel] = PROTOCOL_NOT_MEASURED;
  }
  send_hello(s);
}

/* Not inlined: only the end of a frame needs the stack space of the answers. */
__attribute__((noinline)) static bool on_delimiter(struct supervisor *s, uint32_t now_ms) {
  struct frame frame;
  switch (frame_end(&s->parser, &frame)) {
    case FRAME_GOOD:
      s->rx_good++;
      on_frame(s, &frame, now_ms);
      return true;
    case FRAME_BAD:
      s->rx_bad++;
      return false;
    default:
      return false;
  }
}

bool supervisor_receive(struct supervisor *s, uint8_t byte, uint32_t now_ms) {
  if (byte == PROTOCOL_DELIMITER) {
    return on_delimiter(s, now_ms);
  }
  frame_take(&s->parser, byte);
  return false;
}

uint8_t supervisor_update(struct supervisor *s, const int16_t measured[PROTOCOL_CHANNELS], uint16_t supply_mv,
                          uint32_t now_ms) {
  uint32_t elapsed_ms = now_ms - s->now_ms;
  uint8_t checks;

  s->now_ms = now_ms;
  memcpy(s->measured, measured, sizeof s->measured);
  s->supply_mv = supply_mv;
  if (s->state == STATE_BOOT) {
    s->state = STATE_IDLE;
  }
  checks = check_link(s, now_ms);
  checks |= check_control(s, now_ms);
  checks |= check_sensors(s, elapsed_ms);
  checks |= check_supply(s, elapsed_ms);
  checks |= drive_outputs(s, elapsed_ms);
  if (now_ms - s->last_status_ms >= PROTOCOL_STATUS_PERIOD_MS) {
    s->last_status_ms = now_ms;
    send_status(s);
  }
  return checks;
}

uint16_t supervisor_counts(const struct supervisor *s, uint8_t channel) { return output_counts(&s->output, channel); }

int16_t supervisor_next_byte(struct supervisor *s) { return s->tx_tail == s->tx_head ? -1 : s->tx[s->tx_tail++]; }
