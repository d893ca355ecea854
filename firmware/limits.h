/* Limits of this board. Check the first block against your valves before flashing.
 *
 * Pressures are in the wire's unit, 10 Pa: 0.35 bar is 3500. The host compares these values with its robot file
 * and refuses to arm a board that differs. */
#ifndef LIMITS_H
#define LIMITS_H

#include "protocol.h"

/* ---- To be set for your valves ----------------------------------------------------------------------------- */

/* READ IT FROM THE LABEL OF YOUR VALVES: the pressure at full command (10 V), here 3 bar. */
#ifndef P_FULL
#define P_FULL 30000UL
#endif

/* Pressure at activation 0 and 1; above P_MAX no set-point is accepted. */
#define P_MIN 800
#define P_MAX 3500

/* Fastest change of any output, in 10 Pa per second (20000 is 2 bar/s): set-points and ramped venting alike. */
#ifndef SLEW
#define SLEW 20000U
#endif

/* Pressure at which a sensor gives 5 V; 0 V is no pressure, linear between. Which channels have one: pins.h. */
#define SENSOR_FULL 10000L

/* ---- Safety times and margins ------------------------------------------------------------------------------ */

#define LINK_TIMEOUT_MS 300     /* no valid frame of the session: ramp vent */
#define CONTROL_TIMEOUT_MS 1000 /* the control loop's tick stands still: ramp vent */
#define P_OVER (P_MAX + 1000)   /* a sensor above this ... */
#define OVER_PRESSURE_MS 100    /* ... for this time: dump */
#define P_DISAGREE 500          /* a sensor this far from the applied pressure ... */
#define DISAGREE_MS 2000        /* ... for this time: ramp vent (below: leak; above: sensor or valve stuck) */
#define P_DOWN 500              /* a channel that measures this or more still holds pressure: no fault is cleared */

#define FIRMWARE_VERSION 1

/* After a lost link a ramp from P_MAX must end 670 ms after the last frame; the loop takes up to 40 ms of that. */
_Static_assert(LINK_TIMEOUT_MS + 1000UL * P_MAX / SLEW <= 630, "SLEW is too slow to vent in time");
_Static_assert(0 < P_MIN && P_MIN < P_MAX && P_OVER < P_FULL, "limits out of order: P_MIN < P_MAX < P_OVER < P_FULL");
_Static_assert(P_OVER < SENSOR_FULL && SENSOR_FULL <= 32767, "the sensors cannot see an over-pressure");
_Static_assert(LINK_TIMEOUT_MS >= 2 * PROTOCOL_HEARTBEAT_PERIOD_MS, "one late heartbeat must not trip the link timer");

#endif
