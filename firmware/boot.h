/* The watchdog, and the cause of the last reset. */
#ifndef BOOT_H
#define BOOT_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* A number that changes at every reset, by which the host notices a reset. Call once. */
uint32_t boot_next_id(void);

/* enum reset_cause; call after boot_next_id. */
uint8_t boot_reset_cause(void);

/* Feeds the hardware watchdog; stores the time and the supply, by which the next start infers the cause of a reset. */
void boot_feed_watchdog(uint32_t now_ms, uint16_t supply_mv);

#ifdef __cplusplus
}
#endif
#endif
