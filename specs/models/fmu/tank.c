/* A heated tank that empties through a hole and loses heat through its wall. */
static void derive(double *v, double time) {
    const double out = v[hole] * sqrt(2 * 9.81 * fmax(v[level], 0)), volume = v[area] * fmax(v[level], 1e-6);
    v[der_level] = (v[inflow] - out) / v[area];
    v[der_temperature] = (v[inflow] * (v[supply] - v[temperature])
                          + (v[heat] - v[loss] * (v[temperature] - v[ambient])) / 4.18e6) / volume;
    v[outflow] = out;
}
static void indicate(const double *v, double *z) {}
static int event(double *v) { return 0; }
