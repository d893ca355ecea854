#include "controller.h"

#include <string.h>

#include "limits.h"
#include "pins.h"

static bool in_session(const struct controller *c) { return c->state == STATE_ARMED || c->state == STATE_RUNNING; }

/* ---- To the host ------------------------------------------------------------------------------------------- */

static void send(struct controller *c, uint8_t type, const void *payload, uint8_t length) {
  uint8_t encoded[FRAME_MAX_ENCODED];
  uint8_t head = c->tx_head;
  uint8_t room = (uint8_t)(c->tx_tail - head - 1); /* a full ring would look like an empty one */
  if (FRAME_ENCODED_LENGTH(length) > room) {
    return; /* before the work of encoding: the line carries 25 bytes a millisecond, whatever is asked of us */
  }
  uint16_t to_end = (uint16_t)(sizeof c->tx - head);
  uint8_t size = frame_encode(encoded, type, c->tx_seq++, c->session, payload, length);
  uint8_t first = size < to_end ? size : (uint8_t)to_end;
  memcpy(c->tx + head, encoded, first);
  memcpy(c->tx, encoded + first, (uint8_t)(size - first));
  c->tx_head = (uint8_t)(head + size);
}

static void send_hello(struct controller *c) {
  struct hello hello;
  hello.protocol_hash = PROTOCOL_HASH;
  hello.firmware_version = FIRMWARE_VERSION;
  hello.boot_id = c->boot_id;
  hello.reset_cause = c->reset_cause;
  hello.channels = CHANNELS_USED;
  hello.sensors = SENSORS;
  hello.p_min = P_MIN;
  hello.p_max = P_MAX;
  hello.p_full = P_FULL;
  hello.slew = SLEW;
  hello.link_timeout_ms = LINK_TIMEOUT_MS;
  hello.control_timeout_ms = CONTROL_TIMEOUT_MS;
  send(c, MESSAGE_HELLO, &hello, sizeof hello);
}

static void send_status(struct controller *c) {
  struct status status;
  status.acked_seq = c->last_seq;
  status.state = c->state;
  status.faults = c->faults;
  status.boot_id = c->boot_id;
  status.uptime_ms = c->now_ms;
  status.tick = c->tick;
  memcpy(status.applied, c->output.applied, sizeof status.applied);
  memcpy(status.measured, c->measured, sizeof status.measured);
  status.rx_good = c->rx_good;
  status.rx_bad = c->rx_bad;
  status.rx_refused = c->rx_refused;
  status.supply_mv = c->supply_mv;
  send(c, MESSAGE_STATUS, &status, sizeof status);
}

static void refuse(struct controller *c, const struct frame *frame, enum nack_reason reason) {
  struct nack nack = {frame->type, frame->seq, (uint8_t)reason};
  c->rx_refused++;
  send(c, MESSAGE_NACK, &nack, sizeof nack);
}

/* ---- States ------------------------------------------------------------------------------------------------ */

static void latch(struct controller *c, uint16_t fault) {
  c->faults |= fault;
  c->state = STATE_FAULT;
  if (fault & FAULT_OVER_PRESSURE) {
    output_dump(&c->output);
  }
}

static bool pressures_down(const struct controller *c) {
  if (!output_is_vented(&c->output)) {
    return false;
  }
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    if (c->measured[channel] >= P_DOWN) { /* "not measured" is the most negative number there is */
      return false;
    }
  }
  return true;
}

static void feed_link(struct controller *c, uint32_t now_ms) { c->last_valid_ms = now_ms; }

static void feed_control(struct controller *c, uint32_t tick, uint32_t now_ms) {
  if ((int32_t)(tick - c->tick) > 0) {
    c->tick = tick;
    c->last_progress_ms = now_ms;
  }
}

/* ---- From the host: each function takes a frame of the right length ------------------------------------------ */

static void on_hello_req(struct controller *c, const struct frame *frame) {
  struct hello_req request;
  memcpy(&request, frame->payload, sizeof request);
  send_hello(c); /* always: a stranger has to learn whom it met */
  if (request.protocol_hash != PROTOCOL_HASH) {
    refuse(c, frame, NACK_REASON_HASH);
  }
}

static void on_arm(struct controller *c, const struct frame *frame, uint32_t now_ms) {
  struct arm arm;
  memcpy(&arm, frame->payload, sizeof arm);
  if (arm.protocol_hash != PROTOCOL_HASH) {
    refuse(c, frame, NACK_REASON_HASH);
    return;
  }
  if (arm.boot_id == c->boot_id && c->state == STATE_ARMED && arm.new_session == c->session) {
    send_status(c); /* our answer to the first one was lost */
    return;
  }
  if (arm.boot_id != c->boot_id || arm.new_session != (c->session == 255 ? 1 : c->session + 1)) {
    refuse(c, frame, NACK_REASON_SESSION);
    return;
  }
  if (c->state != STATE_IDLE || !output_is_vented(&c->output) || !c->hears_heartbeats ||
      now_ms - c->last_heartbeat_ms > LINK_TIMEOUT_MS || now_ms - c->heartbeats_since_ms < PROTOCOL_ARM_AFTER_MS) {
    refuse(c, frame, NACK_REASON_STATE);
    return;
  }
  if ((arm.channels >> CHANNELS_USED) != 0 || arm.p_full != P_FULL) {
    refuse(c, frame, NACK_REASON_RANGE);
    return;
  }
  c->state = STATE_ARMED;
  c->session = arm.new_session;
  c->channels = arm.channels;
  c->last_seq = frame->seq;
  c->set_tick = c->tick;
  feed_link(c, now_ms);
  send_status(c);
}

static void on_set(struct controller *c, const struct frame *frame, uint32_t now_ms) {
  struct set set;
  uint8_t ahead = (uint8_t)(frame->seq - c->last_seq);
  memcpy(&set, frame->payload, sizeof set);
  if (!in_session(c)) {
    refuse(c, frame, NACK_REASON_STATE);
    return;
  }
  if (frame->session != c->session) {
    refuse(c, frame, NACK_REASON_SESSION);
    return;
  }
  if (ahead == 0 && c->state == STATE_RUNNING) {
    send_status(c); /* a duplicate: told again, not applied again, and no sign of life */
    return;
  }
  if (ahead == 0 || ahead > PROTOCOL_SEQUENCE_WINDOW || (int32_t)(set.tick - c->set_tick) < 0) {
    refuse(c, frame, NACK_REASON_SEQUENCE);
    return;
  }
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    int16_t pressure = set.pressures[channel];
    if (pressure < 0 || pressure > P_MAX || (pressure != 0 && !((c->channels >> channel) & 1))) {
      refuse(c, frame, NACK_REASON_RANGE); /* never half a frame */
      return;
    }
  }
  memcpy(c->set_points, set.pressures, sizeof c->set_points);
  c->last_seq = frame->seq;
  c->set_tick = set.tick;
  if (c->state == STATE_ARMED) {
    c->state = STATE_RUNNING;
    c->last_progress_ms = now_ms;
  }
  feed_link(c, now_ms);
  feed_control(c, set.tick, now_ms);
  send_status(c);
}

static void on_heartbeat(struct controller *c, const struct frame *frame, uint32_t now_ms) {
  struct heartbeat heartbeat;
  memcpy(&heartbeat, frame->payload, sizeof heartbeat);
  if (in_session(c)) {
    if (frame->session != c->session) {
      refuse(c, frame, NACK_REASON_SESSION);
      return;
    }
    feed_link(c, now_ms);
    feed_control(c, heartbeat.tick, now_ms);
  } else {
    c->tick = heartbeat.tick; /* a new host may count from anywhere */
  }
  if (!c->hears_heartbeats || now_ms - c->last_heartbeat_ms > LINK_TIMEOUT_MS) {
    c->heartbeats_since_ms = now_ms;
    c->hears_heartbeats = true;
  }
  c->last_heartbeat_ms = now_ms;
}

static void on_vent(struct controller *c, const struct frame *frame) {
  struct vent vent;
  memcpy(&vent, frame->payload, sizeof vent);
  if (in_session(c)) {
    c->state = STATE_IDLE;
  }
  if (vent.mode != VENT_MODE_RAMP) { /* an unknown mode still has to vent; at once is the safe reading */
    output_dump(&c->output);
  }
  send_status(c);
}

static void on_clear_fault(struct controller *c, const struct frame *frame) {
  struct clear_fault clear;
  memcpy(&clear, frame->payload, sizeof clear);
  if (c->state != STATE_FAULT || !pressures_down(c)) {
    refuse(c, frame, NACK_REASON_STATE);
    return;
  }
  if (clear.mask != c->faults) {
    refuse(c, frame, NACK_REASON_RANGE);
    return;
  }
  c->faults = 0;
  c->state = STATE_IDLE;
  send_status(c);
}

static void on_frame(struct controller *c, const struct frame *frame, uint32_t now_ms) {
  int16_t expected = protocol_payload_length(frame->type);
  if (expected < 0) {
    refuse(c, frame, NACK_REASON_TYPE);
    return;
  }
  if (frame->length != expected) {
    refuse(c, frame, NACK_REASON_LENGTH);
    return;
  }
  switch (frame->type) {
    case MESSAGE_HELLO_REQ:
      on_hello_req(c, frame);
      break;
    case MESSAGE_ARM:
      on_arm(c, frame, now_ms);
      break;
    case MESSAGE_SET:
      on_set(c, frame, now_ms);
      break;
    case MESSAGE_HEARTBEAT:
      on_heartbeat(c, frame, now_ms);
      break;
    case MESSAGE_VENT:
      on_vent(c, frame);
      break;
    default: /* MESSAGE_CLEAR_FAULT: every other type has been refused above */
      on_clear_fault(c, frame);
  }
}

/* ---- Checks, once a pass -------------------------------------------------------------------------------------- */

static uint8_t check_link(struct controller *c, uint32_t now_ms) {
  if (in_session(c) && now_ms - c->last_valid_ms > LINK_TIMEOUT_MS) {
    latch(c, FAULT_LINK_TIMEOUT);
  }
  return CHECK_LINK;
}

static uint8_t check_control(struct controller *c, uint32_t now_ms) {
  if (c->state == STATE_RUNNING && now_ms - c->last_progress_ms > CONTROL_TIMEOUT_MS) {
    latch(c, FAULT_CONTROL_TIMEOUT);
  }
  return CHECK_CONTROL;
}

/* Counts how long something has been the case; true when it has been for limit_ms. Counts anew after a minute, when
 * what it found has long been latched. */
static bool lasts(uint16_t *counted_ms, bool is, uint32_t elapsed_ms, uint16_t limit_ms) {
  uint32_t lasted_ms = is ? *counted_ms + elapsed_ms : 0;
  *counted_ms = (uint16_t)lasted_ms;
  return lasted_ms >= limit_ms;
}

static uint8_t check_sensors(struct controller *c, uint32_t elapsed_ms) {
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    int16_t measured = c->measured[channel];
    int16_t off;
    bool driven;
    if (measured == PROTOCOL_NOT_MEASURED) {
      continue;
    }
    if (lasts(&c->over_ms[channel], measured > P_OVER, elapsed_ms, OVER_PRESSURE_MS)) {
      latch(c, FAULT_OVER_PRESSURE); /* in any state */
    }
    off = (int16_t)(measured - c->output.applied[channel]); /* both lie between 0 and SENSOR_FULL */
    driven = c->state == STATE_RUNNING && ((c->channels >> channel) & 1);
    if (lasts(&c->above_ms[channel], driven && off > P_DISAGREE, elapsed_ms, DISAGREE_MS)) {
      latch(c, FAULT_SENSOR);
    }
    if (lasts(&c->below_ms[channel], driven && off < -P_DISAGREE, elapsed_ms, DISAGREE_MS)) {
      latch(c, FAULT_LEAK);
    }
  }
  return CHECK_SENSORS;
}

static uint8_t drive_outputs(struct controller *c, uint32_t elapsed_ms) {
  static const int16_t vented[PROTOCOL_CHANNELS];
  output_step(&c->output, c->state == STATE_RUNNING ? c->set_points : vented, elapsed_ms);
  return CHECK_OUTPUTS;
}

/* ---- Interface ------------------------------------------------------------------------------------------------- */

void controller_init(struct controller *c, uint32_t boot_id, uint8_t reset_cause, uint32_t now_ms) {
  memset(c, 0, sizeof *c);
  c->state = STATE_BOOT;
  c->boot_id = boot_id;
  c->reset_cause = reset_cause;
  c->now_ms = now_ms;
  c->last_status_ms = now_ms;
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    c->measured[channel] = PROTOCOL_NOT_MEASURED;
  }
  send_hello(c);
}

/* Not inlined: a byte that ends no frame need not pay for the room that the answers take on the stack. */
__attribute__((noinline)) static bool on_delimiter(struct controller *c, uint32_t now_ms) {
  struct frame frame;
  switch (frame_end(&c->parser, &frame)) {
    case FRAME_GOOD:
      c->rx_good++;
      on_frame(c, &frame, now_ms);
      return true;
    case FRAME_BAD:
      c->rx_bad++;
      return false;
    default:
      return false;
  }
}

bool controller_receive(struct controller *c, uint8_t byte, uint32_t now_ms) {
  if (byte == PROTOCOL_DELIMITER) {
    return on_delimiter(c, now_ms);
  }
  frame_take(&c->parser, byte);
  return false;
}

uint8_t controller_update(struct controller *c, const int16_t measured[PROTOCOL_CHANNELS], uint16_t supply_mv,
                          uint32_t now_ms) {
  uint32_t elapsed_ms = now_ms - c->now_ms;
  uint8_t checks;

  c->now_ms = now_ms;
  memcpy(c->measured, measured, sizeof c->measured);
  c->supply_mv = supply_mv;
  if (c->state == STATE_BOOT) {
    c->state = STATE_IDLE;
  }
  checks = check_link(c, now_ms);
  checks |= check_control(c, now_ms);
  checks |= check_sensors(c, elapsed_ms);
  checks |= drive_outputs(c, elapsed_ms);
  if (now_ms - c->last_status_ms >= PROTOCOL_STATUS_PERIOD_MS) {
    c->last_status_ms = now_ms;
    send_status(c);
  }
  return checks;
}

uint16_t controller_counts(const struct controller *c, uint8_t channel) { return output_counts(&c->output, channel); }

int16_t controller_next_byte(struct controller *c) { return c->tx_tail == c->tx_head ? -1 : c->tx[c->tx_tail++]; }
