/* FMI 3.0, co-simulation and model exchange, of the model in MODEL. */
#include "fmi3Functions.h"
#include "model.h"

#define THIS Instance *i = (Instance *)c
#define OK(condition) ((condition) ? fmi3OK : fmi3Error)

static fmi3Instance instantiate(fmi3String token) {
    if (strcmp(token, TOKEN)) return NULL;
    Instance *i = calloc(1, sizeof *i);
    start(i);
    return i;
}

const char *fmi3GetVersion(void) { return fmi3Version; }
fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String names[]) { return fmi3OK; }
fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment e, fmi3LogMessageCallback log) {
    return instantiate(token);
}
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference required[], size_t n, fmi3InstanceEnvironment e,
                                         fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    return instantiate(token);
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean d, fmi3Float64 tol, fmi3Float64 t, fmi3Boolean e,
                                       fmi3Float64 stop) {
    THIS; i->time = t; return fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { THIS; i->settable = 0; derive(i->v, i->time); return fmi3OK; }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c) { THIS; start(i); return fmi3OK; }

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[], size_t nv) {
    THIS;
    if (i->settable) derive(i->v, i->time);
    for (size_t k = 0; k < n; k++) {
        if (vr[k] >= NV) return fmi3Error;
        value[k] = i->v[vr[k]];
    }
    return fmi3OK;
}
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 value[], size_t nv) {
    THIS;
    for (size_t k = 0; k < n; k++) {
        if (!allowed(i, vr[k])) return fmi3Error;
        i->v[vr[k]] = value[k];
    }
    return fmi3OK;
}
fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *s) {
    if (!*s) *s = malloc(sizeof(Instance));
    memcpy(*s, c, sizeof(Instance));
    return fmi3OK;
}
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState s) { memcpy(c, s, sizeof(Instance)); return fmi3OK; }
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *s) { free(*s); *s = NULL; return fmi3OK; }

/* Co-simulation */
fmi3Status fmi3EnterStepMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean keep, fmi3Boolean *event_, fmi3Boolean *end,
                      fmi3Boolean *early, fmi3Float64 *last) {
    THIS;
    cosimulate(i, t, h);
    *event_ = *end = *early = 0;
    *last = t + h;
    return OK(isfinite(i->v[0]));
}

/* Model exchange */
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *end, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *defined, fmi3Float64 *next) {
    THIS;
    *end = *nominals = *values = *defined = 0;
    *next = 0;
    *again = event(i->v) != 0;
    return fmi3OK;
}
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean keep, fmi3Boolean *enter, fmi3Boolean *end) {
    *enter = *end = 0;
    return fmi3OK;
}
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) { THIS; i->time = t; return fmi3OK; }
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) {
    THIS; memcpy(i->v, x, n * sizeof *x); return OK(n == NX);
}
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    THIS; memcpy(x, i->v, n * sizeof *x); return OK(n == NX);
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 d[], size_t n) {
    THIS; derive(i->v, i->time); memcpy(d, i->v + NX, n * sizeof *d); return OK(n == NX);
}
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) { THIS; indicate(i->v, z); return OK(n == NZ); }
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    for (size_t k = 0; k < n; k++) x[k] = 1;
    return fmi3OK;
}
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) { *n = NZ; return fmi3OK; }
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) { *n = NX; return fmi3OK; }

/* What these models have not, and every FMI 3.0 library exports. */
#define VR fmi3Instance c, const fmi3ValueReference vr[], size_t n
#define ABSENT(Name, ...) fmi3Status fmi3##Name(__VA_ARGS__) { return fmi3Error; }
#define NONE(Type) ABSENT(Get##Type, VR, fmi3##Type v[], size_t nv) ABSENT(Set##Type, VR, const fmi3##Type v[], size_t nv)
NONE(Float32) NONE(Int8) NONE(UInt8) NONE(Int16) NONE(UInt16) NONE(Int32) NONE(UInt32) NONE(Int64) NONE(UInt64)
NONE(Boolean) NONE(String)
ABSENT(GetBinary, VR, size_t sizes[], fmi3Binary v[], size_t nv)
ABSENT(SetBinary, VR, const size_t sizes[], const fmi3Binary v[], size_t nv)
ABSENT(GetClock, VR, fmi3Clock v[])
ABSENT(SetClock, VR, const fmi3Clock v[])
ABSENT(GetNumberOfVariableDependencies, fmi3Instance c, fmi3ValueReference vr, size_t *n)
ABSENT(GetVariableDependencies, fmi3Instance c, fmi3ValueReference vr, size_t a[], fmi3ValueReference b[], size_t d[],
       fmi3DependencyKind e[], size_t n)
ABSENT(SerializedFMUStateSize, fmi3Instance c, fmi3FMUState s, size_t *n)
ABSENT(SerializeFMUState, fmi3Instance c, fmi3FMUState s, fmi3Byte b[], size_t n)
ABSENT(DeserializeFMUState, fmi3Instance c, const fmi3Byte b[], size_t n, fmi3FMUState *s)
ABSENT(GetDirectionalDerivative, VR, const fmi3ValueReference k[], size_t nk, const fmi3Float64 s[], size_t ns, fmi3Float64 d[],
       size_t nd)
ABSENT(GetAdjointDerivative, VR, const fmi3ValueReference k[], size_t nk, const fmi3Float64 s[], size_t ns, fmi3Float64 d[],
       size_t nd)
ABSENT(EnterConfigurationMode, fmi3Instance c)
ABSENT(ExitConfigurationMode, fmi3Instance c)
ABSENT(GetIntervalDecimal, VR, fmi3Float64 v[], fmi3IntervalQualifier q[])
ABSENT(GetIntervalFraction, VR, fmi3UInt64 v[], fmi3UInt64 r[], fmi3IntervalQualifier q[])
ABSENT(GetShiftDecimal, VR, fmi3Float64 v[])
ABSENT(GetShiftFraction, VR, fmi3UInt64 v[], fmi3UInt64 r[])
ABSENT(SetIntervalDecimal, VR, const fmi3Float64 v[])
ABSENT(SetIntervalFraction, VR, const fmi3UInt64 v[], const fmi3UInt64 r[])
ABSENT(SetShiftDecimal, VR, const fmi3Float64 v[])
ABSENT(SetShiftFraction, VR, const fmi3UInt64 v[], const fmi3UInt64 r[])
ABSENT(EvaluateDiscreteStates, fmi3Instance c)
ABSENT(GetOutputDerivatives, VR, const fmi3Int32 o[], fmi3Float64 v[], size_t nv)
ABSENT(ActivateModelPartition, fmi3Instance c, fmi3ValueReference clock, fmi3Float64 t)
fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                               fmi3Boolean logging, fmi3InstanceEnvironment e, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) { return NULL; }
