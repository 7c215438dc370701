/* A room whose heater is switched by a thermostat with hysteresis: whether it is on is the room's memory. */
static void derive(double *v, double time) {
    v[der_temperature] = (v[on] * v[power] + v[sun] - v[loss] * (v[temperature] - v[ambient])) / v[capacity];
}
static void indicate(const double *v, double *z) {
    z[0] = v[temperature] - (v[on] != 0 ? v[high] : v[low]);
}
static int event(double *v) {
    const double was = v[on];
    if (v[temperature] > v[high]) v[on] = 0;
    if (v[temperature] <= v[low]) v[on] = 1;
    return v[on] != was;
}
