/* Definitions for all kernels. They call no library, so one binary runs on every Linux of its architecture. */
#ifndef HBR_KERNELS_H
#define HBR_KERNELS_H

#include <features.h>
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

/* Compile a function for every x86-64 processor, and again for those with AVX2 and AVX-512; the loader chooses. On
   aarch64, vector instructions are always available. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define FOR_EVERY_PROCESSOR __attribute__((target_clones("arch=x86-64-v4", "avx2", "default")))
#else
#define FOR_EVERY_PROCESSOR
#endif

/* A part of such a function. Without this, all versions of the function would call one version of the part. */
#define PART static inline __attribute__((always_inline))

#endif
