/* Pressure sensors and supply voltage, one conversion at a time, never waited for. */
#ifndef SENSORS_H
#define SENSORS_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

struct sensors {
  int16_t measured[PROTOCOL_CHANNELS]; /* 10 Pa; PROTOCOL_NOT_MEASURED without a sensor or before its first reading */
  uint16_t supply_mv;                  /* 5 V rail; 0 before its first reading */
  uint8_t input;                       /* being converted */
  uint8_t rounds;                      /* since the supply was measured */
};

void sensors_begin(struct sensors *sensors);

/* Takes the result of the last conversion and starts the next. Returns false while the conversion still runs. */
bool sensors_poll(struct sensors *sensors);

#ifdef __cplusplus
}
#endif
#endif
